"""Pose tracks from depth: every keyframe as small planes, aligned with all others that see the same surfaces.

`surfels` turns a depth image into planes, `sight` tells what hangs in space that was seen through, `alignment` measures
how two keyframes fit, `motion_prior` what odometry promises, `tracking` walks through the log, `smoothing` aligns all
keyframes at once, and `estimator` puts them together.
"""
