"""When a fit is doubtful: where unseen shapes of a run's data, scanned alike, fit better; kept in the run."""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, TypeAdapter
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

    shapes: Literal[0] | Annotated[int, Field(ge=3)]  # unseen shapes to fit; 0 for no verdicts
    spread: PositiveFloat  # standard deviations that a value's logarithm may lie above the mean of theirs
    reach: PositiveFloat  # times the largest of theirs, however far theirs spread

    def limit(self, measured: Sequence[float]) -> float:
        """The value above which a fit is doubtful, from those of shapes known to be of the kind."""
        values = np.maximum(measured, 1e-12)  # a limit of 0 would have no multiples
        usual = np.exp(np.log(values).mean() + self.spread * np.log(values).std(ddof=1))
        return float(min(usual, self.reach * values.max()))

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
        kept: dict[str, Any] = {}
        with suppress(OSError, ValueError):  # missing or broken: that costs a calibration
            kept = TypeAdapter(dict[str, dict[str, dict[str, Any]]]).validate_json((run / FILE).read_bytes())
        known = kept.setdefault(digest(run, settings), {})
        missing = [kind for kind in kinds if "limits" not in known.get(str(kind), {})]
        shapes = unseen_shapes(self.shapes) if missing else []
        if missing and len(shapes) < 3:
            raise SdfhubError(f"the run's data has {len(shapes)} unseen shapes, a calibration needs 3")
        for kind in missing:
            log.info("calibration: %s: fits %d unseen shapes, once", kind, len(shapes))
            scans = kind.observations(shapes, reconstructor.evidence)
            bar = tqdm(scans, desc="calibrating", unit="scan", leave=False, disable=None)
            fits = [reconstructor.fitted([scan]) for scan in bar]
            residuals = [float(fit.residuals) for fit in fits]
            doubts = [float(reconstructor.doubts(fit)) for fit in fits]
            limits = asdict(Limits(self.limit(residuals), self.limit(doubts)))
            known[str(kind)] = {"limits": limits, "residuals": residuals, "doubts": doubts}
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
