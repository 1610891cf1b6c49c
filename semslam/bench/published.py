"""The figures that the paper prints, beside which ours are put. Source: its tables 1, 3 and 4."""

from __future__ import annotations

from dataclasses import dataclass

from semslam.bench.rows import FAR, FAR_SIDE


@dataclass(frozen=True)
class PosePrint:
    """Position error in metres and heading error in degrees."""

    ape_m: float
    de_deg: float


@dataclass(frozen=True)
class MapPrint:
    """Mean squared error of a map times 100, with the deviation that the paper gives."""

    mse_x100: float
    deviation: float


POSES: dict[tuple[str, str], PosePrint] = {
    ("deepvo", "intra"): PosePrint(2.29, 87.31),
    ("deepvo", "cross"): PosePrint(3.97, 103.7),
    ("mapnet", "intra"): PosePrint(2.40, 106.1),
    ("mapnet", "cross"): PosePrint(3.90, 92.42),
    ("visual", "intra"): PosePrint(2.14, 49.37),
    ("visual", "cross"): PosePrint(3.24, 67.73),
    ("visual_inertial", "intra"): PosePrint(1.61, 34.64),
    ("visual_inertial", "cross"): PosePrint(2.39, 57.11),
    ("semantic_cell", "cross"): PosePrint(3.80, 80.50),
}
POSES |= {(f"{row}_h_{FAR_SIDE}", protocol): one for (row, protocol), one in POSES.items() if row.startswith("visual")}
"""By row and protocol. The text says h = 11, the authors' code 33: which of them was printed is not known."""

UNPRINTED = {"orb_rgbd": "N/A"}
"""Rows that the paper has without figures, and what it prints for them."""

MAPS: dict[tuple[str, str], MapPrint] = {
    ("convlstm", "real"): MapPrint(2.51, 0.21),
    ("convlstm", "obstructed"): MapPrint(2.42, 0.21),
    ("convlstm", "ideal"): MapPrint(2.05, 0.29),
    ("leaky_0.1", "real"): MapPrint(2.90, 0.06),
    ("leaky_0.1", "obstructed"): MapPrint(3.21, 0.04),
    ("leaky_0.1", "ideal"): MapPrint(3.17, 0.05),
    ("leaky_0.3", "real"): MapPrint(2.57, 0.12),
    ("leaky_0.3", "obstructed"): MapPrint(3.18, 0.10),
    ("leaky_0.3", "ideal"): MapPrint(3.26, 0.15),
    ("leaky_0.7", "real"): MapPrint(2.57, 0.28),
    ("leaky_0.7", "obstructed"): MapPrint(3.65, 0.26),
    ("leaky_0.7", "ideal"): MapPrint(4.77, 0.41),
    ("leaky_1.0", "real"): MapPrint(2.94, 0.45),
    ("leaky_1.0", "obstructed"): MapPrint(4.35, 0.41),
    ("leaky_1.0", "ideal"): MapPrint(6.65, 0.59),
}
MAPS |= {(method, FAR): one for (method, quality), one in MAPS.items() if quality == "real"}
"""By method and what the maps were built from; likewise."""
