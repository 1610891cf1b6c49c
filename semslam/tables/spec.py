"""Every table of data_spec.md as plain data; a test keeps the two equal.

Pure Python on purpose: planning a run needs the tables' names, and must not pay for importing pyarrow.
Conventions (time, frames, grid, missing values) stand in data_spec.md.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One column: `type` is a word of `TYPES`, `unit` is empty for pure numbers, `null` says if it may miss."""

    name: str
    type: str
    unit: str
    null: bool
    meaning: str


@dataclass(frozen=True)
class Table:
    """One table: a file `NAME.parquet` (or one per shard) written by exactly one stage."""

    name: str
    number: int
    stage: str
    columns: tuple[Column, ...]
    version: int = 1
    """Rises with every change of the columns; stored in every file and refused when another one is read."""


TYPES = (
    "bool",
    "int8",
    "int32",
    "int64",
    "uint16",
    "uint32",
    "uint64",
    "float32",
    "float64",
    "string",
    "binary",
    "list<int64>",
    "list<uint32>",
    "list<float32>",
    "list<float64>",
)


def _c(name: str, kind: str, unit: str, meaning: str, *, null: bool = False) -> Column:
    return Column(name, kind, unit, null, meaning)


_FRAME = _c("frame", "int32", "", "keyframe index within the log, from 0")
_STAMP = _c("stamp_nanos", "int64", "ns", "header stamp of the colour image, Unix time")

TOPICS = Table(
    "topics",
    1,
    "ingest",
    (
        _c("topic", "string", "", "topic name"),
        _c("schema_name", "string", "", "message type as the log names it; empty if the channel has no schema"),
        _c("message_encoding", "string", "", "cdr, ros1, protobuf, json, ..."),
        _c("role", "string", "", "what ingest used it for: colour, depth, colour_info, ...; null if unused", null=True),
        _c("messages", "uint64", "", "messages read"),
        _c("skipped", "uint64", "", "messages that could not be decoded or used"),
        _c("reason", "string", "", "why messages were skipped or the topic refused; null if nothing was", null=True),
        _c("first_log_time_nanos", "int64", "ns", "log time of the first message; null without messages", null=True),
        _c("last_log_time_nanos", "int64", "ns", "log time of the last message; null without messages", null=True),
        _c("max_gap_s", "float64", "s", "longest pause between two messages; null below two messages", null=True),
        _c("clock_jumps", "uint32", "", "times the stamping clock was set; late writing does not count"),
    ),
)

FRAMES = Table(
    "frames",
    2,
    "ingest",
    (
        _FRAME,
        _STAMP,
        _c("log_time_nanos", "int64", "ns", "log time of the colour message"),
        _c("colour", "binary", "", "JPEG or PNG file, colour or grey, rectified (pinhole)"),
        _c(
            "depth",
            "binary",
            "",
            "16-bit PNG file, millimetres along the optical axis, registered to colour; 0 = missing",
        ),
        _c("depth_offset_nanos", "int64", "ns", "stamp of the depth image minus stamp of the colour image"),
        _c("width", "int32", "px", "columns of colour and depth"),
        _c("height", "int32", "px", "rows of colour and depth"),
        _c("fx", "float64", "px", "focal length along columns"),
        _c("fy", "float64", "px", "focal length along rows"),
        _c("cx", "float64", "px", "principal point, column; the centre of the first pixel is 0"),
        _c("cy", "float64", "px", "principal point, row"),
        _c(
            "robot_from_camera",
            "list<float64>",
            "m",
            "4x4 matrix, row by row: optical camera frame to levelled robot frame",
        ),
        _c("roll_rad", "float64", "rad", "tilt that levelling removed about the robot's x axis"),
        _c("pitch_rad", "float64", "rad", "tilt that levelling removed about the robot's y axis, nose down positive"),
        _c("level_source", "string", "", "tf, imu or none"),
        _c("camera_height_m", "float64", "m", "height of the camera above the floor (also in robot_from_camera)"),
        _c(
            "height_source",
            "string",
            "",
            "tf, config, floor (plane seen in this frame), held (from earlier frames) or none",
        ),
    ),
)

MOTION = Table(
    "motion",
    3,
    "ingest",
    (
        _FRAME,
        _STAMP,
        _c(
            "dx_m",
            "float64",
            "m",
            "forward motion since the previous keyframe, in its robot frame; null if unknown",
            null=True,
        ),
        _c("dy_m", "float64", "m", "leftward motion, likewise", null=True),
        _c("dheading_rad", "float64", "rad", "left turn, likewise, in (-pi, pi]", null=True),
        _c("source", "string", "", "start (first keyframe), odometry, tf, imu or none"),
    ),
)

TRUTH = Table(
    "truth",
    4,
    "ingest",
    (
        _FRAME,
        _STAMP,
        _c("x_m", "float64", "m", "true position of the robot frame in the truth's own world frame"),
        _c("y_m", "float64", "m", "likewise"),
        _c("z_m", "float64", "m", "likewise"),
        _c("heading_rad", "float64", "rad", "true direction of the robot's x axis on the ground plane"),
        _c("roll_rad", "float64", "rad", "true tilt of the truth's body about its x axis"),
        _c("pitch_rad", "float64", "rad", "true tilt about its y axis, nose down positive"),
    ),
)

DETECTIONS = Table(
    "detections",
    5,
    "extract",
    (
        _FRAME,
        _STAMP,
        _c("detection", "int32", "", "index within the frame, from 0, by falling score"),
        _c("class_id", "uint16", "", "index into the class list"),
        _c("label", "string", "", "class name after remapping"),
        _c("source_label", "string", "", "class name as the detector gave it"),
        _c("score", "float32", "", "confidence, 0 to 1"),
        _c("x0_px", "float32", "px", "left edge of the box"),
        _c("y0_px", "float32", "px", "top edge of the box"),
        _c("x1_px", "float32", "px", "right edge of the box, exclusive"),
        _c("y1_px", "float32", "px", "bottom edge of the box, exclusive"),
        _c("mask_runs", "list<uint32>", "px", "run lengths of the mask row by row, background first"),
        _c("mask_pixels", "uint32", "px", "pixels in the mask"),
        _c("depth_pixels", "uint32", "px", "pixels in the mask with usable depth"),
        _c("min_x_m", "float64", "m", "3D extent in the robot frame, 2nd percentile; null without depth", null=True),
        _c("min_y_m", "float64", "m", "likewise", null=True),
        _c("min_z_m", "float64", "m", "likewise; 0 is the floor", null=True),
        _c("max_x_m", "float64", "m", "98th percentile", null=True),
        _c("max_y_m", "float64", "m", "likewise", null=True),
        _c("max_z_m", "float64", "m", "likewise", null=True),
    ),
)

OBSERVATIONS = Table(
    "observations",
    6,
    "extract",
    (
        _FRAME,
        _STAMP,
        _c("cells", "list<uint32>", "", "(class_id * side + iy) * side + ix of each non-zero entry, rising"),
        _c("weights", "list<float32>", "", "value of each entry, 0 to 1 (equation 1); parallel to cells"),
        _c("objects", "int32", "", "detections that reached the observation"),
    ),
)

POSES = Table(
    "poses",
    7,
    "localize",
    (
        _FRAME,
        _STAMP,
        _c(
            "x_m", "float64", "m", "position of the robot in the map frame; null if the estimator gives none", null=True
        ),
        _c("y_m", "float64", "m", "likewise", null=True),
        _c("heading_rad", "float64", "rad", "direction of the robot's x axis in the map frame, (-pi, pi]", null=True),
        _c("source", "string", "", "start, visual, inertial or none"),
        _c("verdict", "string", "", "ok, uncertain or lost"),
        _c(
            "covariance",
            "list<float64>",
            "m, rad",
            "3x3 matrix of x, y and heading along the map's axes, row by row; empty if the estimator tells none",
        ),
        _c("peak", "float64", "", "probability of the best pose bin; null without a pose field", null=True),
        _c("entropy_nats", "float64", "nat", "entropy of the pose field; null without one", null=True),
        _c("mode_x_m", "list<float64>", "m", "top modes of the pose field, best first; empty without one"),
        _c("mode_y_m", "list<float64>", "m", "likewise"),
        _c("mode_heading_rad", "list<float64>", "rad", "likewise"),
        _c("mode_probability", "list<float64>", "", "probability of each mode's bin"),
    ),
    version=2,
)

SNAPSHOTS = Table(
    "snapshots",
    8,
    "localize",
    (
        _FRAME,
        _STAMP,
        _c("rows", "int32", "", "cells along y"),
        _c("columns", "int32", "", "cells along x"),
        _c("cell_m", "float64", "m", "side of a cell"),
        _c("origin_x_m", "float64", "m", "map frame x of the lower corner of cell ix = 0"),
        _c("origin_y_m", "float64", "m", "map frame y of the lower corner of cell iy = 0"),
        _c("cells", "list<uint32>", "", "(class_id * rows + iy) * columns + ix of each non-zero entry, rising"),
        _c("weights", "list<float32>", "", "probability of each entry; parallel to cells"),
    ),
)

CELLS = Table(
    "cells",
    9,
    "localize",
    (
        _c("ix", "int32", "", "cell column; the cell covers [ix, ix + 1) * cell_m along x of the map frame"),
        _c("iy", "int32", "", "cell row, likewise along y"),
        _c("x_m", "float64", "m", "cell centre in the map frame"),
        _c("y_m", "float64", "m", "cell centre in the map frame"),
        _c("class_id", "uint16", "", "most probable class, an index into the class list"),
        _c("label", "string", "", "its name"),
        _c("probability", "float32", "", "probability of that class"),
        _c("hits", "uint32", "", "keyframes that saw this class in the cell; 0 if only the hull of a thing holds it"),
        _c("views", "uint32", "", "keyframes that saw the cell at all"),
        _c("first_seen_nanos", "int64", "ns", "stamp of the first keyframe that saw the cell"),
        _c("last_seen_nanos", "int64", "ns", "stamp of the last keyframe that saw the cell"),
    ),
)

TRAJECTORY = Table(
    "trajectory",
    10,
    "export",
    (
        _FRAME,
        _STAMP,
        _c("x_m", "float64", "m", "position of the robot in the map frame"),
        _c("y_m", "float64", "m", "likewise"),
        _c("heading_rad", "float64", "rad", "direction of the robot's x axis in the map frame, (-pi, pi]"),
        _c("verdict", "string", "", "ok or uncertain"),
    ),
    version=2,
)

EVALUATION = Table(
    "evaluation",
    11,
    "evaluate",
    (
        _c("log", "string", "", "log name"),
        _c("estimator", "string", "", "estimator name, or `chance` or `standstill`"),
        _c("frames", "int32", "", "keyframes with truth"),
        _c("coverage", "float64", "", "share of those keyframes with a pose, 0 to 1"),
        _c(
            "ape_m",
            "float64",
            "m",
            "mean position error without alignment beyond the first pose; null without poses",
            null=True,
        ),
        _c("de_deg", "float64", "deg", "mean absolute heading error; null without poses", null=True),
        _c("ape_worst_m", "float64", "m", "largest position error", null=True),
        _c("de_worst_deg", "float64", "deg", "largest heading error", null=True),
        _c("ok", "float64", "", "share of the keyframes with truth whose verdict is ok, 0 to 1"),
        _c(
            "ok_wrong",
            "float64",
            "",
            "share of those that are farther off than `localize.ok_m` or `localize.ok_rad`; null if none is ok",
            null=True,
        ),
    ),
    version=2,
)

SPLITS = Table(
    "splits",
    12,
    "simulate",
    (
        _c("log", "string", "", "log name: the file is `logs/NAME.mcap`"),
        _c("variant", "string", "", "kind of home: standard, plain, repeating, symmetric, rooms or person"),
        _c("scene", "int32", "", "number of the home, from 0; its variants and its days share it"),
        _c("day", "int32", "", "day of the home, from 0"),
        _c("trajectory", "int32", "", "number of the drive through the scene, from 0"),
        _c("intra", "string", "", "train or test; null if the scene has a single trajectory", null=True),
        _c("cross", "string", "", "train or test; null if the data set has a single scene", null=True),
    ),
)

TRUE_MAP = Table(
    "true_map",
    13,
    "simulate",
    (
        _c("cell_m", "float64", "m", "side of a cell: which grid of the metadata the row belongs to"),
        _c("row", "int32", "", "cell along y, from 0 at the lowest y"),
        _c("column", "int32", "", "cell along x, from 0 at the lowest x"),
        _c("x_m", "float64", "m", "cell centre in the map frame"),
        _c("y_m", "float64", "m", "cell centre in the map frame"),
        _c("class_id", "uint16", "", "true class, an index into the class list; unobserved cells have no row"),
        _c("first_seen_frame", "int32", "", "keyframe to which the cell was visible first; null if to none", null=True),
    ),
)

HOME_OBJECTS = Table(
    "home_objects",
    14,
    "simulate",
    (
        _c("instance", "int32", "", "id in the instance images, from 1"),
        _c("class_id", "uint16", "", "index into the class list"),
        _c("label", "string", "", "its name"),
        _c("style", "string", "", "kind of chair, table, ..."),
        _c("x_m", "float64", "m", "middle of the footprint in the home's frame, that of the truth topics"),
        _c("y_m", "float64", "m", "likewise"),
        _c("z_m", "float64", "m", "height of what it stands on; 0 is the floor"),
        _c("yaw_rad", "float64", "rad", "direction of its front"),
        _c("height_m", "float64", "m", "from what it stands on to its top"),
        _c("footprint", "list<float64>", "m", "outline in the home's frame, counter-clockwise: x, y, x, y, ..."),
    ),
)

VIEWS = Table(
    "views",
    15,
    "train",
    (
        _c("view", "int32", "", "index within the home, from 0"),
        _c("colour", "binary", "", "JPEG file"),
        _c("depth", "binary", "mm", "16-bit PNG file, registered to colour; 0 where missing"),
        _c(
            "instances",
            "binary",
            "",
            "16-bit PNG file: id of the object of every pixel; 0 is the building and loose things",
        ),
        _c("fx", "float64", "px", "focal length across"),
        _c("fy", "float64", "px", "focal length down"),
        _c("cx", "float64", "px", "principal point across"),
        _c("cy", "float64", "px", "principal point down"),
        _c("camera_height_m", "float64", "m", "above the floor"),
        _c("camera_pitch_rad", "float64", "rad", "nose down is positive"),
        _c(
            "instance",
            "list<int64>",
            "",
            "ids of the objects in view; this and the next columns have one entry an object",
        ),
        _c("class_id", "list<int64>", "", "index into the class names of the file's metadata"),
        _c(
            "boxes_px",
            "list<float64>",
            "px",
            "left, top, right, bottom of the visible pixels, four an object; right and bottom exclusive",
        ),
        _c("pixels", "list<int64>", "", "visible pixels"),
        _c(
            "share",
            "list<float64>",
            "",
            "of the silhouette that is visible, 0 to 1; what lies beyond the picture counts as hidden",
        ),
        _c("cut", "list<int64>", "", "1 if the object touches the edge of the picture, else 0"),
    ),
)

PLACES = Table(
    "places",
    16,
    "localize",
    (
        _FRAME,
        _STAMP,
        _c("map_from_robot", "list<float64>", "m", "4x4 matrix, row by row: levelled robot frame to map frame"),
        _c("points", "list<float32>", "m", "x, y, z of each surfel in the robot frame, one after the other"),
        _c("normals", "list<float32>", "", "unit normals of the surfels, towards the camera, likewise"),
        _c("sigma_m", "list<float32>", "m", "standard deviation of each surfel's place along its normal"),
        _c("depth", "binary", "mm", "16-bit PNG file: the thinned depth image; 0 where missing or too far"),
        _c("fx", "float64", "px", "focal length of the thinned image along columns"),
        _c("fy", "float64", "px", "focal length along rows"),
        _c("cx", "float64", "px", "principal point, column; the centre of the first pixel is 0"),
        _c("cy", "float64", "px", "principal point, row"),
        _c(
            "robot_from_camera",
            "list<float64>",
            "m",
            "4x4 matrix, row by row: optical camera frame to levelled robot frame",
        ),
        _c("cells", "list<uint32>", "", "the keyframe's observation, as in table 6; empty without one"),
        _c("weights", "list<float32>", "", "value of each entry, likewise"),
    ),
)

OBJECTS = Table(
    "objects",
    17,
    "export",
    (
        _c("object", "int32", "", "index, from 0, by falling evidence"),
        _c("class_id", "uint16", "", "index into the class list"),
        _c("label", "string", "", "its name"),
        _c("x_m", "float64", "m", "centroid of the footprint in the map frame"),
        _c("y_m", "float64", "m", "likewise"),
        _c("area_m2", "float64", "m2", "area of the footprint"),
        _c("height_m", "float64", "m", "top above the floor"),
        _c("footprint", "list<float64>", "m", "outline in the map frame, convex, counter-clockwise: x, y, x, y, ..."),
        _c("score", "float32", "", "mean confidence of its detections, 0 to 1"),
        _c("frames", "list<int64>", "", "keyframes that saw it, rising"),
        _c("first_seen_nanos", "int64", "ns", "stamp of the first of them"),
        _c("last_seen_nanos", "int64", "ns", "stamp of the last of them"),
    ),
)

LAYERS = Table(
    "layers",
    18,
    "export",
    (
        _c("ix", "int32", "", "cell column; the cell covers [ix, ix + 1) * cell_m along x of the map frame"),
        _c("iy", "int32", "", "cell row, likewise along y"),
        _c("x_m", "float64", "m", "cell centre in the map frame"),
        _c("y_m", "float64", "m", "cell centre in the map frame"),
        _c(
            "occupancy",
            "float32",
            "",
            "probability that an obstacle stands above the cell; null if too little was seen",
            null=True,
        ),
        _c("floor_m", "float32", "m", "height of the floor, median; null if none was seen", null=True),
        _c("top_m", "float32", "m", "top of the highest obstacle; null if there is none", null=True),
        _c("points", "uint32", "", "depth pixels that fell into the cell, of those looked at"),
        _c("views", "uint32", "", "keyframes that saw something of the column above the cell"),
    ),
)

SITES = Table(
    "sites",
    19,
    "merge",
    (
        _c("log", "string", "", "log name"),
        _c("site", "string", "", "its site: the name of the site's first log, and of its folder"),
        _c("verdict", "string", "", "first, found, ambiguous, lost or contradicted"),
        _c("x_m", "float64", "m", "where the log's own map frame lies in the site's"),
        _c("y_m", "float64", "m", "likewise"),
        _c("heading_rad", "float64", "rad", "likewise, (-pi, pi]"),
        _c(
            "covariance",
            "list<float64>",
            "m, rad",
            "3x3 matrix of that x, y and heading, row by row; empty if it is not known",
        ),
        _c("keyframes", "int32", "", "keyframes of the log in table 16"),
        _c("ties", "int32", "", "pairs that surfaces tie of its keyframes and those of other logs"),
        _c("other", "string", "", "the log on whose site it was laid for the verdict; null if on none", null=True),
        _c(
            "likeness",
            "float64",
            "",
            "log likelihood ratio of a sample there, right pose against wrong one; null if no pose was likely at all",
            null=True,
        ),
        _c("probability", "float64", "", "of the best way to lie there among all ways; null likewise", null=True),
    ),
)

ALL_TABLES: tuple[Table, ...] = (
    TOPICS, FRAMES, MOTION, TRUTH, DETECTIONS, OBSERVATIONS, POSES, SNAPSHOTS, CELLS, TRAJECTORY, EVALUATION,
    SPLITS, TRUE_MAP, HOME_OBJECTS, VIEWS, PLACES, OBJECTS, LAYERS, SITES,
)  # fmt: skip
