"""A run's folder of a space of four balls, trained in a second, as training leaves it behind."""

import json
from pathlib import Path

import numpy as np
import torch

from sdfhub.checkpoint_file import LAST, write_checkpoint
from sdfhub.composition import plain
from sdfhub.model.losses import clamped_l1
from sdfhub.opening import begin_run
from sdfhub.shapes import Frame
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed

IDS = ["balls/small", "balls/medium", "balls/large", "balls/huge"]
RADII = [0.4, 0.45, 0.5, 0.55]
FRAME = Frame(np.array([1.0, 2.0, 3.0]), 0.5)
"""Of all but the last, whose frame is not known."""

SMALL = ["activation=siren", "encoding=none", "decoder.depth=2", "decoder.width=32", "decoder.code_size=4"]
SMALL += ["decoder.inject_code=[1]"]


def write_ball_run(run: Path) -> Path:
    """Trains on balls of RADII, one code more than there are ids, and writes the run's folder."""
    config = composed(*SMALL)
    model = build_autodecoder(config, rows=5)
    stream = batches(shapes=4, per_step=4, samples=256, surface=0)
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for step in range(300):
        optimizer.param_groups[0]["lr"] = 5e-3 * (1 - step / 300)
        batch = stream[step]
        loss = clamped_l1(model.decoder(batch.points, model.codes(batch.rows)), batch.sdf, 0.1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    begin_run(run, plain(config), IDS, [], {id: FRAME for id in IDS[:3]}, "z")
    checkpoint = {"state_dict": model.state_dict(), "hyper_parameters": dict(model.hparams)}
    write_checkpoint(checkpoint, run / "checkpoints" / LAST)
    (run / "metrics.json").write_text(json.dumps({"train": {"summary": {"cd": {"mean": 1.0}}}}))
    return run
