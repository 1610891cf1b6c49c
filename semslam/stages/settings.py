"""Configuration of every stage: frozen dataclasses, plain values, stable under JSON, because they feed the cache key.

The text under a field is its documentation: meaning, unit, range, paper symbol. `pipeline/config.py` reads TOML into
these, checks the ranges declared with `setting` and prints them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any


def setting(
    default: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] | None = None,
    file: bool = False,
) -> Any:
    """A field with what is allowed: a closed range, words to choose from (of every item, for a tuple), or `file`.

    A `file` field holds a path; the cache key takes the content of the file in its place.
    """
    metadata = {"low": low, "high": high, "choices": tuple(choices) if choices else None, "file": file}
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class IngestConfig:
    """From log to keyframes."""

    topics: Mapping[str, str] = setting({})
    """Topics by role, for what the guess gets wrong: colour, depth, colour_info, depth_info, imu, odometry, truth."""
    truth_frame: str = setting("")
    """Frame whose pose the truth topic tells, where its messages do not say; empty takes the robot's."""
    keyframes: str = setting("time", choices=("time", "motion"))
    """Take a keyframe every `period_s`, or when odometry or tf has moved by `min_distance_m` or `min_turn_rad`."""
    period_s: float = setting(1.0, low=0.0, high=3600.0)
    """Least time between keyframes, seconds. 0 keeps every pair."""
    min_distance_m: float = setting(0.3, low=0.0, high=100.0)
    """With keyframes = "motion": distance that makes a keyframe, metres."""
    min_turn_rad: float = setting(0.35, low=0.0, high=3.15)
    """With keyframes = "motion": turn that makes a keyframe, radians."""
    pair_tolerance_s: float = setting(0.03, low=0.0, high=10.0)
    """Colour and depth whose stamps differ by more are no pair, seconds."""
    motion: str = setting("auto", choices=("auto", "odometry", "tf", "imu", "none"))
    """Where u_t comes from; auto takes odometry, else tf, else the IMU, step by step."""
    motion_gap_s: float = setting(0.5, low=0.0, high=3600.0)
    """A source with a longer pause around a keyframe cannot speak for that step, seconds."""
    levelling: str = setting("auto", choices=("auto", "tf", "imu", "none"))
    """Where roll and pitch come from; auto takes a gravity-aligned frame of tf, else accelerometer and gyro."""
    robot_frame: str = setting("")
    """Frame of the robot's body; empty takes base_footprint or base_link if tf connects it, else the camera's root."""
    camera_height_m: float = setting(0.0, low=0.0, high=50.0)
    """Height of the camera above the floor, metres; 0 takes it from tf, else from the floor in the depth images."""
    depth_unit_m: float = setting(0.0, low=0.0, high=1.0)
    """Metres of one step of integer depth; 0 takes the convention (1 mm)."""
    shard_frames: int = setting(200, low=1, high=100000)
    """Keyframes a shard: what a killed run loses at most."""


@dataclass(frozen=True)
class ExtractConfig:
    """From keyframes to detections and observation maps (equation 1)."""

    detector: str = setting("", file=True)
    """ONNX file of the detector; empty takes the shipped one."""
    adapter: str = setting("auto")
    """Layout of the detector's inputs and outputs; auto recognises it (`semslam models inspect FILE.onnx`)."""
    classes: str = setting("", file=True)
    """Text file with the detector's class names, one a line; empty takes them from the model's metadata."""
    segmenter: str = setting("auto", choices=("auto", "sam", "depth_box", "box"))
    """How a box becomes a mask; auto takes the masks of the detector if it gives any, else those of the encoder and
    decoder below, else, with the shipped detector, those of the shipped pair; else depth_box: GrabCut with depth."""
    segmenter_encoder: str = setting("", file=True)
    """ONNX file of the segmenter's image encoder; empty, like the decoder, takes the shipped one where it is wanted."""
    segmenter_decoder: str = setting("", file=True)
    """ONNX file of the segmenter's box-prompted mask decoder."""
    min_score: float = setting(0.3, low=0.0, high=1.0)
    """Detections below this confidence are dropped."""
    max_overlap: float = setting(0.5, low=0.0, high=1.0)
    """Non-maximum suppression: boxes of one class that overlap more (IoU) are one object."""
    select: tuple[str, ...] = setting(())
    """Class names to keep, before remapping; empty keeps all."""
    exclude: tuple[str, ...] = setting(("person",))
    """Class names to drop, before remapping. People move, so maps leave them out by default."""
    remap: Mapping[str, str] = setting({})
    """New names for classes; several may share one."""
    cell_m: float = setting(0.1, low=0.01, high=10.0)
    """Cell of the observation map, metres."""
    side: int = setting(99, low=3, high=2001)
    """Cells along a side of the observation map, odd; the camera stands at the centre. h, before pooling."""
    min_depth_m: float = setting(0.3, low=0.0, high=100.0)
    """Nearer depth is ignored, metres."""
    max_depth_m: float = setting(6.0, low=0.1, high=1000.0)
    """Farther depth is ignored, metres."""
    floor_tolerance_m: float = setting(0.08, low=0.0, high=1.0)
    """Points within this height of the floor are floor, metres."""
    max_height_m: float = setting(2.0, low=0.1, high=100.0)
    """Points higher than this are no obstacle (ceilings, lamps), metres."""
    min_pixels: int = setting(3, low=1, high=10000)
    """Floor or obstacle pixels that a cell needs before it counts as seen."""
    shard_frames: int = setting(100, low=1, high=100000)
    """Keyframes a shard: what a killed run loses at most."""
    batch: int = setting(1, low=1, high=16)
    """Keyframes that the detector sees at once, if its file leaves the batch size open. More than one gains something
    on a GPU alone, and each costs about 40 MB at 640 x 480. On a processor no result depends on it."""


@dataclass(frozen=True)
class PaperConfig:
    """The estimator of the paper, equations 2 to 8 and 10."""

    cell_m: float = setting(0.3, low=0.01, high=10.0)
    """Cell of the map, metres; an odd multiple of extract.cell_m."""
    map_side: int = setting(33, low=3, high=501)
    """Cells along a side of the map. H = W."""
    side: int = setting(11, low=3, high=2001)
    """Cells along a side of the observation. h."""
    headings: int = setting(360, low=1, high=3600)
    """Heading bins. R."""
    noise_floor: float = setting(0.02, low=0.0, high=1.0)
    """Observation cells below this become 0. beta."""
    binary: bool = setting(False)
    """Set observation cells above the noise floor to 1."""
    temperature: float = setting(1.0, low=1e-6, high=1e6)
    """Correlation is divided by this before the softmax of equation 2; 1 in the paper."""
    gate_distance_m: float = setting(0.3, low=0.0, high=1e6)
    """Largest position difference of visual and inertial pose, metres: 3 sigma of a step's noise (0.09 m) and the
    rounding to a cell (half its diagonal, 0.21 m). gamma_1."""
    gate_heading_rad: float = setting(0.1, low=0.0, high=3.2)
    """Largest heading difference, radians: 3 sigma of a step's noise (0.08 rad) and half a degree of bias. gamma_2."""
    gate: str = setting("all", choices=("all", "any"))
    """Accept the visual pose if all, or any, of the two differences are below their gates (equation 4 says all)."""
    update: str = setting("leaky", choices=("leaky", "learned"))
    """How the map takes up what was placed on it: the leaky average (equation 10) or a network (equation 8)."""
    leak: float = setting(0.3, low=0.0, high=1.0)
    """With update = "leaky": weight of a new observation in the map. alpha of equation 10."""
    model: str = setting("", file=True)
    """With update = "learned": ONNX file of the network; empty takes the shipped one."""


@dataclass(frozen=True)
class MapNetConfig:
    """MapNet (Henriques and Vedaldi, 2018): image features on a grid, matched with a map of them."""

    model: str = setting("", file=True)
    """ONNX file of the network, which brings its own grid; empty takes the shipped one."""


@dataclass(frozen=True)
class DeepVoConfig:
    """DeepVO (Wang et al., 2017): motion from pairs of pictures by a recurrent network."""

    model: str = setting("", file=True)
    """ONNX file of the network; empty takes the shipped one."""


@dataclass(frozen=True)
class OrbConfig:
    """Keypoint SLAM after ORB-SLAM2 (Mur-Artal and Tardos, 2017) on colour and depth; it uses no motion."""

    features: int = setting(1000, low=50, high=10000)
    """Keypoints a picture, at most, spread over a grid."""
    max_depth_m: float = setting(10.0, low=0.1, high=1000.0)
    """Farther depth makes no map point, metres."""
    min_matches: int = setting(15, low=4, high=10000)
    """Fewer matches with the map than this and the frame has no pose."""
    min_inliers: int = setting(10, low=4, high=10000)
    """Fewer matches than this that agree with the pose and the frame has no pose."""
    map_inliers: int = setting(30, low=4, high=10000)
    """Points of the local map that must agree with a pose at last, or the frame is looked for in all keyframes."""
    relocalise_inliers: int = setting(50, low=4, high=10000)
    """Likewise for a frame that was looked for in all keyframes, or it has no pose."""
    ratio: float = setting(0.8, low=0.1, high=1.0)
    """A match counts if its descriptor distance is below this share of the second best's."""
    inlier_px: float = setting(3.0, low=0.1, high=100.0)
    """Largest reprojection error of an inlier at the finest pyramid level, pixels."""
    keyframe_share: float = setting(0.75, low=0.0, high=1.0)
    """A frame that tracks fewer than this share of its reference keyframe's points becomes a keyframe."""
    local_keyframes: int = setting(10, low=1, high=1000)
    """Keyframes whose points make the local map."""
    max_keyframes: int = setting(300, low=1, high=100000)
    """Keyframes kept for relocalisation; the oldest goes first."""


@dataclass(frozen=True)
class SurfelConfig:
    """Alignment of depth images with each other, all at once, motion where they say nothing."""

    surfels: int = setting(1200, low=100, high=10000)
    """Small planes kept of a keyframe, at most."""
    max_depth_m: float = setting(6.0, low=0.5, high=1000.0)
    """Farther depth is ignored, metres."""
    neighbours: int = setting(12, low=2, high=100)
    """Keyframes that a keyframe is aligned with, at most: those that see most of the same."""
    position_noise_m: float = setting(0.03, low=1e-6, high=100.0)
    """Random error of motion over a second along each axis, metres."""
    heading_noise_rad: float = setting(0.026, low=1e-6, high=10.0)
    """Random error of the turn over a second, radians."""
    position_bias_m: float = setting(0.04, low=1e-9, high=100.0)
    """Steady error of motion over a second, which is estimated: how large it may be (1 sigma), metres."""
    heading_bias_rad: float = setting(0.02, low=1e-9, high=10.0)
    """Steady error of the turn over a second, likewise, radians."""
    tilt_noise_rad: float = setting(0.03, low=1e-6, high=10.0)
    """How far from upright a keyframe may be found (1 sigma), radians: errors of levelling."""
    height_noise_m: float = setting(0.3, low=1e-6, high=100.0)
    """How far above or below the floor that ingest tells a keyframe may be found (1 sigma), metres: for hand-held
    cameras whose height is only known where they see the floor."""
    prior: str = setting("", file=True)
    """places.parquet of a map made before, in which logs are to be found without a first guess; empty for none."""
    rounds: int = setting(10, low=0, high=100)
    """Times, at most, that all keyframes are aligned with each other at the end; 0 keeps the track as it was walked,
    without covariances, and what was not found while walking is found no more."""


_PAPER = ("paper", "paper_visual")
"""Estimators that share section `[localize.paper]`."""
_VARIANTS = "variants"
"""Of a section that only some variants look at: which. The cache keys of others do not hold it."""


@dataclass(frozen=True)
class LocalizeConfig:
    """From observations and motion to poses and maps."""

    estimators: tuple[str, ...] = setting(
        ("surfel", "dead_reckoning"),
        choices=("surfel", "paper", "paper_visual", "dead_reckoning", "mapnet", "deepvo", "orb_rgbd"),
    )
    """Estimators to run; each gives its own track and map. surfel aligns the depth images of the whole log and takes
    motion where they say nothing; paper is visual-inertial, paper_visual visual only; mapnet, deepvo and orb_rgbd look
    at the pictures themselves and never at the motion."""
    surfel: SurfelConfig = field(default_factory=SurfelConfig, metadata={_VARIANTS: ("surfel",)})
    """Section `[localize.surfel]`."""
    paper: PaperConfig = field(default_factory=PaperConfig, metadata={_VARIANTS: _PAPER})
    """Section `[localize.paper]`."""
    mapnet: MapNetConfig = field(default_factory=MapNetConfig, metadata={_VARIANTS: ("mapnet",)})
    """Section `[localize.mapnet]`."""
    deepvo: DeepVoConfig = field(default_factory=DeepVoConfig, metadata={_VARIANTS: ("deepvo",)})
    """Section `[localize.deepvo]`."""
    orb_rgbd: OrbConfig = field(default_factory=OrbConfig, metadata={_VARIANTS: ("orb_rgbd",)})
    """Section `[localize.orb_rgbd]`."""
    max_keyframes: int = setting(0, low=0, high=10**9)
    """Localise only the first so many keyframes of a log; 0 for all."""
    snapshot_every: int = setting(10, low=1, high=100000)
    """Keyframes between two map snapshots; the last keyframe always has one."""
    modes: int = setting(5, low=1, high=100)
    """Modes of the pose field kept a frame."""
    shard_frames: int = setting(200, low=1, high=100000)
    """Keyframes a shard: what a killed run loses at most."""
    ok_m: float = setting(0.1, low=1e-6, high=1e6)
    """A pose is `ok` if it is nearer to the truth than this with 95 % probability, metres, and ..."""
    ok_rad: float = setting(0.035, low=1e-6, high=10.0)
    """... its heading than this, radians: 2 degrees."""

    @property
    def uses_map_update(self) -> bool:
        """Whether any of the estimators opens the network of equation 8."""
        return self.paper.update == "learned" and any(name in _PAPER for name in self.estimators)

    def for_variant(self, estimator: str) -> LocalizeConfig:
        """The configuration of one estimator alone, so that its cache key ignores the settings of the others."""
        sections = {item.name: item for item in fields(self) if _VARIANTS in item.metadata}
        others = [name for name, item in sections.items() if estimator not in item.metadata[_VARIANTS]]
        plain = {name: type(getattr(self, name))() for name in others}
        return replace(self, estimators=(estimator,), **plain)


@dataclass(frozen=True)
class ExportConfig:
    """From tables to files for people and other tools."""

    pixels_per_cell: int = setting(0, low=0, high=200)
    """Pixels of the map picture a cell; 0 chooses a picture of about 1000 pixels."""
    layer_cell_m: float = setting(0.05, low=0.02, high=10.0)
    """Cell of the occupancy and height layers and of the map_server file, metres."""
    layer_depth_m: float = setting(6.0, low=0.5, high=20.0)
    """Farther depth is ignored in the layers, metres."""
    min_obstacle_height_m: float = setting(0.1, low=0.0, high=10.0)
    """What is lower is floor to the robot, metres."""
    max_obstacle_height_m: float = setting(1.5, low=0.1, high=10.0)
    """What is higher is above the robot, metres."""
    occupied_threshold: float = setting(0.65, low=0.0, high=1.0)
    """occupied_thresh of the map_server file: cells more probably occupied than this are written as occupied."""
    free_threshold: float = setting(0.196, low=0.0, high=1.0)
    """free_thresh of the map_server file: cells less probably occupied than this are written as free. 0.196 is what it
    reads for the grey of unknown cells."""
    object_frames: int = setting(2, low=1, high=100000)
    """Keyframes that must have seen an object of the objects table."""
    object_depth_m: float = setting(6.0, low=0.5, high=1000.0)
    """Farther points belong to no object of that table, metres."""
