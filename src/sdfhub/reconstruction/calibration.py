"""When a fit is doubtful: where unseen shapes of a run's data, scanned alike, fit better; kept in the run."""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat, TypeAdapter
from pydantic.dataclasses import dataclass
from tqdm import tqdm

from sdfhub.checkpoint_file import LAST
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.reconstruction.reconstructor import Limits, Reconstructor
from sdfhub.scans.evidence import BOUNDS
from sdfhub.scans.simulated import VIEWS, ScanKind
from sdfhub.whole_file import file_sha256, write_whole

log = logging.getLogger(__name__)

FILE = "calibration.json"
RULE = "residual, residual * (1 + unusual)^4, in the units of the scan"  # limits of others count no more


@dataclass(frozen=True)
class Calibration:
    """How limits are found."""

    shapes: NonNegativeInt  # unseen shapes to fit, >= 3; 0 for no verdicts
    spread: PositiveFloat  # standard deviations that a value's logarithm may lie above the mean of theirs
    reach: PositiveFloat  # times the largest of theirs, however far theirs spread

    def __post_init__(self):
        if 0 < self.shapes < 3:
            raise ValueError("shapes must be at least 3, or 0 for no verdicts")

    def limit(self, values: np.ndarray) -> float:
        """The value above which a fit is doubtful, from those [S] of shapes known to be of the kind."""
        values = np.maximum(values, 1e-12)  # a limit of 0 would have no multiples
        usual = np.exp(np.log(values).mean() + self.spread * np.log(values).std(ddof=1))
        return float(min(usual, self.reach * np.max(values)))

    def limits(
        self,
        run: Path,
        settings: dict[str, Any],
        kinds: Sequence[ScanKind],
        reconstructor: Reconstructor,
        unseen_shapes: Callable[[int], list[StoredShape]],
    ) -> dict[ScanKind, Limits]:
        """The limits of kinds of scans: the run's own, or measured now and kept in its folder.

        `settings` are all that fits depend on, `unseen_shapes` gives up to so many shapes of the run's data.
        """
        key = digest(run, settings)
        kept = _read(run / FILE)
        known = kept.setdefault(key, {})
        missing = [kind for kind in kinds if "limits" not in known.get(str(kind), {})]
        shapes = unseen_shapes(self.shapes) if missing else []
        if missing and len(shapes) < 3:
            raise SdfhubError(f"the run's data has {len(shapes)} unseen shapes, a calibration needs 3")
        for kind in missing:
            log.info("calibration: %s: fits %d unseen shapes, once", kind, len(shapes))
            residuals, doubts = [], []
            scans = kind.observations(shapes, reconstructor.evidence)
            for scan in tqdm(scans, desc="calibrating", unit="scan", leave=False, disable=None):
                fitted = reconstructor.fitted([scan])
                residuals.append(float(fitted.residuals))
                doubts.append(float(reconstructor.doubts(fitted)))
            found = {"residual": self.limit(np.array(residuals)), "doubt": self.limit(np.array(doubts))}
            known[str(kind)] = {"limits": found, "residuals": residuals, "doubts": doubts}
            known[str(kind)]["shapes"] = [shape.id for shape in shapes]
            try:
                write_whole(run / FILE, json.dumps(kept, indent=1))
            except OSError as error:  # another user's run: the limits serve this command at least
                log.warning("%s: is not kept: %s", run / FILE, error.strerror)
        return {kind: Limits(**known[str(kind)]["limits"]) for kind in kinds}


def digest(run: Path, settings: dict[str, Any]) -> str:
    """What a run's weights and the settings of a fit are told apart by."""
    weights = file_sha256(run / "checkpoints" / LAST)
    text = json.dumps([weights, settings, RULE, VIEWS, BOUNDS], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read(path: Path) -> dict[str, Any]:
    """What is kept; nothing where the file is missing or broken, which costs a calibration."""
    try:
        return TypeAdapter(dict[str, dict[str, dict[str, Any]]]).validate_json(path.read_bytes())
    except (OSError, ValueError):
        return {}
