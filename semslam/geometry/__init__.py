"""Frames, cameras, levelling, grids and projection: pure functions on arrays, SI units, right-handed frames.

Frames (parent_from_child names a transform): `camera` is optical (x right, y down, z forward); `robot` is levelled
(x forward, y left, z up, floor at z = 0); `map` starts at the first keyframe's robot pose.
"""
