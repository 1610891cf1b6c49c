"""The learned map: equation 8, a ConvLSTM over what was placed, in ONNX Runtime on the region of interest alone.

Hidden and cell state are kept raw, and the map is read from them: m = softmax(kappa h) over the classes of a cell. A
step reads the region of interest (equation 7) with a halo of as many cells as the kernel reaches, zero beyond the
map's border, and writes the region: all other cells stay as they are, bit for bit, and a step costs the same in a map
of any size.

The network's file says in its metadata what it was trained for (`ModelCard`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semslam.errors import SemslamError
from semslam.geometry.grid import Planes
from semslam.labels import UNOBSERVED
from semslam.models.session import Session, open_session
from semslam.slam.paper import Window, around

_INPUTS, _OUTPUTS = ("placed", "hidden", "cell"), ("new_hidden", "new_cell")
_WHAT = "map update"


@dataclass(frozen=True)
class ModelCard:
    """What a map update's metadata say."""

    classes: tuple[str, ...]
    """The reserved ones first."""
    kappa: float
    """Steepness of the read-out."""
    cell_m: float
    side: int
    """Cells along a side of the observation. h."""
    kernel: int
    """Cells along a side of the convolutions: 3, or 1 for an LSTM a cell."""
    binary: bool | None
    """Whether its observations were binary; None where the file does not say."""
    initial_hidden: NDArray[np.float32]
    """(L,) raw state of cells that nothing updated yet; where the file leaves it out, one-hot *unobserved*."""
    initial_cell: NDArray[np.float32]
    """(L,), where the file leaves it out, zero."""

    @staticmethod
    def read(path: Path, metadata: Mapping[str, str]) -> ModelCard:
        """The card of the network at `path`.

        Raises:
            SemslamError: something is missing or makes no sense.
        """
        try:
            classes = tuple(str(name) for name in json.loads(metadata["classes"]))
            card = ModelCard(
                classes=classes,
                kappa=float(metadata["kappa"]),
                cell_m=float(metadata["cell_m"]),
                side=int(metadata["side"]),
                kernel=int(metadata["kernel"]),
                binary=metadata["binary"] == "true" if "binary" in metadata else None,
                initial_hidden=_initial(metadata, "initial_hidden", np.eye(len(classes))[UNOBSERVED]),
                initial_cell=_initial(metadata, "initial_cell", np.zeros(len(classes))),
            )
        except KeyError as error:
            raise _no_map_update(path, f"its metadata lack {error.args[0]!r}") from error
        except (ValueError, TypeError, IndexError) as error:
            raise _no_map_update(path, f"its metadata cannot be read: {error}") from error
        if not (0 < card.kappa < np.inf and card.kernel % 2 == 1 and card.kernel > 0):
            raise _no_map_update(path, f"its kappa is {card.kappa:g} and its kernel {card.kernel}")
        return card


def _initial(metadata: Mapping[str, str], key: str, default: NDArray[Any]) -> NDArray[np.float32]:
    values = np.array(json.loads(metadata[key]) if key in metadata else default, np.float32)
    if values.shape != default.shape or not np.isfinite(values).all():
        raise ValueError(f"{key} must hold {len(default)} numbers")
    return values


class LearnedMap:
    """A map that a network updates."""

    def __init__(self, session: Session, card: ModelCard, map_side: int) -> None:
        self._session = session
        self._card = card
        shape = (len(card.classes), map_side, map_side)
        self._hidden = np.broadcast_to(card.initial_hidden[:, None, None], shape).copy()  # (L, H, W)
        self._cell = np.broadcast_to(card.initial_cell[:, None, None], shape).copy()  # (L, H, W)
        self._planes = self._read(self._hidden)

    @staticmethod
    def open(
        model: Path, classes: Sequence[str], map_side: int, cell_m: float, side: int, *, binary: bool = False
    ) -> LearnedMap:
        """An empty map of `map_side` cells of `cell_m` metres, for observations of `side` cells with that class list.

        Raises:
            SemslamError: the file is no map update, or one for other classes, cells or observations.
        """
        session = open_session(model, threads=1, what=_WHAT)
        _check_signature(session)
        card = ModelCard.read(model, session.signature.metadata)
        _check_fits(model, card, tuple(classes), cell_m, side)
        if card.binary not in (None, binary):
            kinds = {True: "binary", False: "weighted"}
            raise SemslamError(
                f"Map update `{model}` was trained on {kinds[not binary]} observations, but "
                f"`localize.paper.binary` makes them {kinds[binary]}",
                hint=f"`--set localize.paper.binary={str(not binary).lower()}`, or train another one",
            )
        return LearnedMap(session, card, map_side)

    @property
    def planes(self) -> Planes:
        """The map m_t (L, H, W), the estimator's own: copy it before you keep it."""
        return self._planes

    def update(self, placed: Planes, window: Window) -> None:
        """Equation 8 in the window (equation 7); `placed` (L, rows, columns) is what equation 6 laid there."""
        if not placed.size:
            return
        hidden = around(self._hidden, window, self._card.kernel // 2)
        rows, columns = window
        cell = self._cell[:, rows, columns]
        feeds = {"placed": placed, "hidden": hidden, "cell": cell}
        new_hidden, new_cell = self._session.run({n: np.ascontiguousarray(v[None]) for n, v in feeds.items()})[:2]
        if new_hidden.shape[1:] != placed.shape or new_cell.shape[1:] != placed.shape:
            raise _no_map_update(
                self._session.path, f"it gives states {list(new_hidden.shape)} for a region {list(placed.shape)}"
            )
        self._hidden[:, rows, columns], self._cell[:, rows, columns] = new_hidden[0], new_cell[0]
        self._planes[:, rows, columns] = self._read(new_hidden[0])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What the map remembers; the read-out follows from it."""
        return {"hidden": self._hidden, "cell": self._cell}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `arrays`."""
        self._hidden, self._cell = arrays["hidden"].copy(), arrays["cell"].copy()
        self._planes = self._read(self._hidden)

    def _read(self, hidden: NDArray[np.float32]) -> Planes:
        """m = softmax(kappa h) over the classes of each cell, (L, ...) -> (L, ...)."""
        raised = np.float32(self._card.kappa) * (hidden - hidden.max(0))
        weights = np.exp(raised)
        return np.asarray(weights / weights.sum(0), np.float32)


def _check_signature(session: Session) -> None:
    for found, wanted in ((session.signature.inputs, _INPUTS), (session.signature.outputs, _OUTPUTS)):
        if [tensor.name for tensor in found] != list(wanted):
            names = ", ".join(tensor.name for tensor in found)
            raise _no_map_update(session.path, f"it has {names} where {', '.join(wanted)} are wanted")


def _check_fits(model: Path, card: ModelCard, classes: tuple[str, ...], cell_m: float, side: int) -> None:
    """Whether the network was trained for such observations."""
    if card.classes != classes:
        raise SemslamError(
            f"Map update `{model}` was trained for other classes than the observations have",
            details=f"map update:   {', '.join(card.classes)}\nobservations: {', '.join(classes)}",
            hint="train one on these observations (`semslam train mapper`), or `--set localize.paper.update=leaky`",
        )
    for key, trained, given in (("cell_m", card.cell_m, cell_m), ("side", card.side, side)):
        if not abs(trained - given) <= 1e-6 * given:
            raise SemslamError(
                f"Map update `{model}` was trained with {key} {trained:g}, but `localize.paper.{key}` is {given:g}",
                hint=f"set `localize.paper.{key}` to {trained:g}, or train one for {given:g}",
            )


def _no_map_update(path: Path, reason: str) -> SemslamError:
    return SemslamError(
        f"Model `{path}` is no map update: {reason}",
        hint="train one with `semslam train mapper`, or look at it with `semslam models inspect FILE.onnx`",
    )
