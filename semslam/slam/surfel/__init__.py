"""Pose tracks from depth: every keyframe as small planes, aligned with all others that see the same surfaces.

`surfels` turns a depth image into planes, `sight` tells what hangs in space that was seen through, `alignment` measures
how two keyframes fit, `motion_prior` what odometry promises. `search` finds a keyframe among others (`places`),
`tracking` walks through the log, `coverage` tells what need not be kept, `smoothing` aligns all keyframes at once, and
`estimator` puts them together. `registration` lays a map on another: for `prior`, a map made before; for `rejoining`,
parts of a log; and for `merging`, logs of one place.
"""
