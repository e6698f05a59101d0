"""When a fit is doubtful: where unseen shapes of a run's own data, scanned alike, left less.

A run keeps its calibrations in `calibration.json`, one a kind of scan, so that each is measured once.
"""

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sdfhub.data.loading import SdfDataModule
from sdfhub.data.splits import Split, split
from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.scans.evidence import BOUNDS, Evidence
from sdfhub.scans.scan import LEAST, Scan
from sdfhub.scans.scanning import surface_scan, view_scan
from sdfhub.scans.target import Target, observed
from sdfhub.tasks.build import build
from sdfhub.whole_file import file_sha256, write_whole

FILE = "calibration.json"
RULE = "residual, residual * (1 + unusual)^4, in the units of the scan"
"""What is judged: kept beside the settings, so that limits of another rule are not taken for these."""
NOISES = (0.0, 0.0035, 0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056)
"""Levels of noise that are calibrated apart, normalised frame."""
DISTANCE, HEIGHT = 2.5, 0.5
"""Of simulated sensors from the origin, and how far up they may stand, as a sine."""
PIXELS = 100
LOOKS = 20
"""Places tried for a sensor, until it sees enough points to know a shape."""

VIEWS = 2
"""Simulated of each shape: what one leaves depends on where the sensor stood."""


@dataclass(frozen=True)
class Calibration:
    """How limits are found.

    Args:
        shapes: unseen shapes to fit, >= 3; 0 for no verdicts.
        spread: standard deviations that a value's logarithm may lie above the mean of theirs, > 0.
        reach: times the largest of theirs, however far theirs spread, > 0.
    """

    shapes: int
    spread: float
    reach: float

    def __post_init__(self):
        if (self.shapes < 3 and self.shapes != 0) or min(self.spread, self.reach) <= 0:
            raise ValueError("shapes must be at least 3, or 0 for no verdicts; spread and reach positive")

    def limit(self, values: np.ndarray) -> float:
        """The value above which a fit is doubtful, from those [S] of shapes known to be of the kind."""
        values = np.maximum(values, 1e-12)  # a limit of 0 would have no multiples
        logarithms = np.log(values)
        usual = np.exp(logarithms.mean() + self.spread * logarithms.std(ddof=1))
        return float(min(usual, self.reach * np.max(values)))


@dataclass(frozen=True)
class Limits:
    """What residual and doubt of a fit may be at most, for it not to be doubtful."""

    residual: float
    doubt: float


@dataclass(frozen=True)
class Alike:
    """What scans have in common that are judged by the same limits: what can be simulated.

    Args:
        kind: samples, oriented, bare or view.
        count: points, a power of two; 0 where their number does not matter.
        noise: one of NOISES.
    """

    kind: str
    count: int
    noise: float

    @classmethod
    def to(cls, target: Target) -> "Alike":
        """What a target is like."""
        if target.kind == "samples":
            return cls("samples", 0, 0.0)
        least = 0.95 * target.observation.noise  # what is noisier leaves more
        noise = next((level for level in NOISES if level >= least), NOISES[-1])
        power = np.clip(round(np.log2(target.count)), 6, 16)
        return cls(target.kind, 0 if target.kind == "view" else int(2**power), noise)

    def __str__(self) -> str:
        count = f", {self.count} points" if self.count else ""
        return f"{self.kind}{count}" + (f", noise {self.noise:g}" if self.noise else "")

    def targets(self, shapes: Sequence[StoredShape], evidence: Evidence) -> list[Target]:
        """Simulated scans of shapes, observed: one of each, several where each is but a view."""
        again = range(VIEWS if self.kind == "view" else 1)
        return [self.target(shape, evidence, number) for shape in shapes for number in again]

    def target(self, shape: StoredShape, evidence: Evidence, number: int = 0) -> Target:
        """A simulated scan of a shape, in the normalised frame, observed; another number gives another."""
        rng = np.random.default_rng([shape_seed(shape), number])
        return observed(self.scan(shape, number), evidence, "normalised", rng)

    def scan(self, shape: StoredShape, number: int = 0) -> Scan:
        """A simulated scan of a shape, in the normalised frame; another number gives another one.

        Raises:
            SdfhubError: the shape has no mesh to be scanned.
        """
        rng = np.random.default_rng([shape_seed(shape), number])
        if self.kind == "samples":
            rows = np.concatenate([shape.outside, shape.inside]).astype(np.float64)
            return Scan(rows[:, :3], sdf=rows[:, 3])
        mesh = shape.mesh
        if mesh is None:
            raise SdfhubError(f"the run's data has no meshes, so that no scan ({self}) can be simulated")
        if self.kind == "view":
            for _ in range(LOOKS):
                sensor = random_sensor(rng, shape.up)
                points = view_scan(mesh, sensor, PIXELS, self.noise, rng)
                if len(points) >= LEAST:  # a rod seen along its axis shows less
                    return Scan(points, sensor=sensor)
            raise SdfhubError(f"{shape.id}: is too thin to be seen from anywhere")
        points, normals = surface_scan(mesh, self.count, self.noise, rng)
        return Scan(points, normals if self.kind == "oriented" else None)


def random_sensor(rng: np.random.Generator, up: str) -> np.ndarray:
    """[3] a place around the unit ball, not far above or below its middle."""
    height, turn = rng.uniform(-HEIGHT, HEIGHT), rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - height**2)
    x, y, z = flat * np.cos(turn), flat * np.sin(turn), height
    return DISTANCE * np.array([x, y, z] if up == "z" else [x, z, y])


class Fitter(Protocol):
    """What is calibrated.

    Attributes:
        evidence: what a scan says.
    """

    evidence: Evidence

    def judged(self, targets: Sequence[Target]) -> np.ndarray:
        """Residuals and doubts [B, 2] of targets."""


def calibrated(
    run: Path,
    trained: dict[str, Any],
    roles: dict[str, list[str]],
    calibration: Calibration,
    kinds: Sequence[Alike],
    fitter: Fitter,
    settings: dict[str, Any],
    data: dict[str, Any],
) -> dict[Alike, Limits]:
    """The limits of each kind of scan: the run's own, or measured now and kept.

    Args:
        run: its folder; trained and roles are its config and split.
        calibration: how.
        kinds: that are wanted.
        fitter: fits targets.
        settings: plain, all that fits depend on.
        data: keys that stand in for the run's own (store, workers).

    Raises:
        SdfhubError: the run's data cannot be had here, or it has too few unseen shapes.
    """
    key = _digest(run, settings)
    known = _read(run / FILE).get(key, {})
    missing = [each for each in kinds if "limits" not in known.get(str(each), {})]
    shapes = unseen_shapes(trained, roles, data, calibration.shapes) if missing else []
    for each in missing:
        print(f"calibration: {each}: fits {len(shapes)} unseen shapes, once", flush=True)
        residuals, doubts = fitter.judged(each.targets(shapes, fitter.evidence)).T
        entry = {"limits": {"residual": calibration.limit(residuals), "doubt": calibration.limit(doubts)}}
        entry |= {"residuals": residuals.tolist(), "doubts": doubts.tolist()}
        kept = _read(run / FILE)  # again: another process may have added to it meanwhile
        known = kept.get(key, {}) | known | {str(each): entry | {"shapes": [shape.id for shape in shapes]}}
        try:
            write_whole(run / FILE, json.dumps(kept | {key: known}, indent=1))
        except OSError as error:  # somebody else's run: what was found serves this command at least
            print(f"{run / FILE}: is not kept: {error.strerror}", file=sys.stderr)
    return {each: Limits(**known[str(each)]["limits"]) for each in kinds}


def unseen_shapes(
    trained: dict[str, Any], roles: dict[str, list[str]], data: dict[str, Any], count: int
) -> list[StoredShape]:
    """Up to `count` shapes that a run was not trained on: its held-out ones, then others of its source."""
    data = trained["data"] | {name: value for name, value in data.items() if value is not None}
    loader: SdfDataModule = build(data, "data", within="sdfhub.data")
    offered = {shape.id: shape for shape in loader.source.shapes()}
    first = [offered[id] for id in roles["held_out"] if id in offered][:count]
    used = {*roles["train"], *roles["held_out"]}
    others = [shape for id, shape in offered.items() if id not in used and shape.split != "train"]
    others = [shape for shape in others if shape.split == "held_out"] or others
    more = split(others, 0, min(count - len(first), len(others)), seed=0).held_out
    found = list(loader.filled(Split([], first + more)))
    if len(found) < 3:
        raise SdfhubError(f"the run's data has {len(found)} unseen shapes, a calibration needs 3")
    return found


def _digest(run: Path, settings: dict[str, Any]) -> str:
    """What a run's weights and the settings of a fit are told apart by."""
    weights = file_sha256(run / "checkpoints" / "last.ckpt")
    text = json.dumps([weights, settings, RULE, VIEWS, BOUNDS], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(path: Path) -> dict[str, Any]:
    """What is kept; nothing where the file is missing or broken, which costs a calibration."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        return {key: {kind: dict(entry) for kind, entry in kinds.items()} for key, kinds in kept.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
