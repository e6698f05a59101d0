"""A training killed every few minutes against an undisturbed one: nothing may be lost.

Run: python benchmarks/soak.py [--minutes 120] [--every 3] [--seed 0] [--folder soak]

Trains one run to its end, and beside it the same while signals reach it at random moments (SIGKILL, SIGTERM,
SIGINT), each time started again by the same command. Prints how often it was stopped, and whether weights and
final loss are those of the undisturbed run, bit by bit; status 1 where they are not.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from sdfhub.checkpoint_file import LAST, read_checkpoint

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
EXPECTED = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}
CALIBRATION = 40
"""Epochs from whose time the number of epochs is worked out."""


def command(folder: Path, name: str, epochs: int) -> list[str]:
    """A small training on the CPU: steps of some milliseconds, a checkpoint every second or so."""
    words = ["scale=tiny", "data.held_out=0", "callbacks=quiet", "trainer=cpu", "evaluate=fast"]
    words += ["evaluate.train=2", "data.preparation.samples=20000", "trainer.enable_progress_bar=false"]
    words += [f"trainer.max_epochs={epochs}", f"data.store={folder / 'store'}"]
    return [sys.executable, "train.py", *words, f"hydra.run.dir={folder / name}"]


def seconds_of(folder: Path, name: str) -> float:
    """Seconds of a whole training, as it has written them."""
    return json.loads((folder / name / "metrics.json").read_text())["training"]["seconds"]


def disturbed(folder: Path, epochs: int, every: float, chance: random.Random) -> dict[str, int]:
    """Trains to the end in spite of signals; how often each of them stopped it."""
    stops = dict.fromkeys((number.name for number in SIGNALS), 0)
    while True:
        with (folder / "disturbed.log").open("a") as log:
            process = subprocess.Popen(command(folder, "disturbed", epochs), cwd=ROOT, stdout=log, stderr=log)
            try:
                status = process.wait(timeout=every * chance.uniform(0.5, 1.5))
            except subprocess.TimeoutExpired:
                number = chance.choice(SIGNALS)
                process.send_signal(number)
                status = process.wait()
                if status == EXPECTED[number] or status == -number:  # the latter outside of its steps
                    stops[number.name] += 1
                    continue
        if status:
            raise SystemExit(f"ended with status {status}: see {folder / 'disturbed.log'}")
        return stops


def main() -> None:
    """Prints one table; status 1 where the two trainings differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=120, help="of training")
    parser.add_argument("--every", type=float, default=3, help="minutes between signals, on average")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("soak"), help="must not be there yet")
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", "1")
    args.folder.mkdir(parents=True)
    folder = args.folder.resolve()
    subprocess.run(
        command(folder, "calibration", CALIBRATION), cwd=ROOT, check=True, stdout=subprocess.DEVNULL
    )
    epochs = max(2, round(60 * args.minutes / seconds_of(folder, "calibration") * CALIBRATION))
    undisturbed = subprocess.Popen(
        command(folder, "undisturbed", epochs), cwd=ROOT, stdout=subprocess.DEVNULL
    )
    start = time.monotonic()
    stops = disturbed(folder, epochs, 60 * args.every, random.Random(args.seed))
    wall = time.monotonic() - start
    if undisturbed.wait():
        raise SystemExit(f"the undisturbed training ended with status {undisturbed.returncode}")
    seconds = seconds_of(folder, "undisturbed")
    states, losses = [], []
    for name in ("undisturbed", "disturbed"):
        states.append(read_checkpoint(folder / name / "checkpoints" / LAST)["state_dict"])
        losses.append(json.loads((folder / name / "metrics.json").read_text())["training"]["loss"]["end"])
    same = all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    left = [path.name for path in (folder / "disturbed" / "checkpoints").iterdir() if path.name != LAST]
    print("| epochs | undisturbed s | disturbed s, with starts | stops | same weights | loss | leftovers |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    told = ", ".join(f"{count} {name}" for name, count in stops.items())
    loss = f"{losses[0]:.6g} and {losses[1]:.6g}"
    cells = [epochs, f"{seconds:.0f}", f"{wall:.0f}", told, "yes" if same else "NO", loss, len(left)]
    print(f"| {' | '.join(map(str, cells))} |")
    sys.exit(int(not same or losses[0] != losses[1]))


if __name__ == "__main__":
    main()
