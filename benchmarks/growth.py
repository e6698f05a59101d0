"""How training grows with the number of shapes: start-up, samples a second, peak memory, size of the codes.

    python benchmarks/growth.py [--rounds 3] [--steps 100] [--real 20] [--keep]

Runs train.py on 10, 100 and 1000 procedural tables of 500,000 samples from a warm store, the counts one after
the other in every round, and prints medians over the rounds as a Markdown table; beside them what importing
torch and lightning alone costs here. Steps are the same for all: 10 shapes, 512 samples and 64 surface points
of each. Then it times the drawing of such batches from 1000 shapes by itself, and of the paper's (64 shapes,
16,384 samples and 4096 surface points of each), whose limit is the rate at which memory is copied here.

Only the first `--real` shapes are prepared; the others' files are copies of theirs, written under their own
ids and fingerprints: speed and memory depend on the number and size of files, not on what they hold.
`--real 1000` prepares all (about an hour a core). The store takes 9 GB under outputs/benchmarks/growth, and
goes at the end unless --keep.

Start-up lasts from the start of the process to the end of its first optimiser step; its processor time is
read from /proc every 20th of a second, and tells more than the clock on a machine that others use. Memory is
the peak resident set of the training process, libraries and all: `ru_maxrss` of wait4; it has no children.
"""

import argparse
import dataclasses
import os
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from runs import OUTPUTS, ROOT, head, row
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sdfhub.data.loading.batches import Loading, StepBatches
from sdfhub.data.preparation.sampling import Preparation
from sdfhub.data.sources import ProceduralSource
from sdfhub.data.splits import split
from sdfhub.data.store import store, stored_shape
from sdfhub.data.store.store import Store
from sdfhub.model.fast.computing import keep_freed_memory

FOLDER = OUTPUTS / "growth"
COUNTS = (10, 100, 1000)
PER_STEP, SAMPLES, SURFACE = 10, 512, 64
PAPER_STEP = 64, 16_384, 4096
"""Shapes, samples and surface points of each, as at scale=paper."""
WARM_UP = 20
"""Steps left out of the speed."""


@dataclass(frozen=True)
class Growth:
    """What one run of train.py took: seconds, of the processor too, samples a second, bytes."""

    start_up: float
    processor: float
    speed: float
    memory: int
    codes: int
    checkpoint: int


def filled_store(real: int) -> Store:
    """The store of as many tables as the largest count, `real` of them prepared, the others copied."""
    source, preparation = ProceduralSource({"tables": {}}, count=COUNTS[-1]), Preparation()
    shapes = split(source.shapes(), train=None, held_out=0, seed=0).train
    prepared = list(store.prepare(source, shapes[:real], preparation, FOLDER / "store").values())
    folder = FOLDER / "store" / source.name / store.preparation_hash(preparation)
    for index, shape in enumerate(shapes[real:]):
        path = folder / f"{shape.id}{stored_shape.SUFFIX}"
        if not path.exists():
            copy_shape(prepared[index % len(prepared)], path, shape.fingerprint)
    return store.prepare(source, shapes, preparation, FOLDER / "store")


def copy_shape(twin: stored_shape.StoredShape, path: Path, fingerprint: str) -> None:
    """Writes the arrays of a prepared shape as those of another."""
    arrays = {name: twin.read(name, 0, rows) for name in stored_shape.COLUMNS if (rows := twin.rows(name))}
    stored_shape.write_shape(path, arrays, dataclasses.replace(twin.record, fingerprint=fingerprint))


def trained(shapes: int, steps: int) -> Growth:
    """Trains `steps` steps on the first shapes of the store."""
    run = FOLDER / f"run_{shapes}"
    shutil.rmtree(run, ignore_errors=True)
    overrides = [
        *("category=tables", f"data.shapes={shapes}", "data.held_out=0", f"data.store={FOLDER / 'store'}"),
        *(f"data.loader.shapes_per_step={PER_STEP}", f"data.loader.samples_per_shape={SAMPLES}"),
        *(f"data.loader.surface_per_shape={SURFACE}", "callbacks=none", "evaluate.train=0"),
        "++trainer.limit_val_batches=0",
        *("trainer=cpu", "trainer.max_epochs=1", "trainer.log_every_n_steps=1"),
        *(f"data.loader.passes_per_epoch={steps * PER_STEP // shapes}", f"hydra.run.dir={run}"),
    ]
    started = time.time()
    spent, memory = watched([sys.executable, "train.py", *overrides])
    events = EventAccumulator(str(run / "tensorboard")).Reload().Scalars("loss/total")
    times = [event.wall_time for event in events]
    speed = (len(times) - 1 - WARM_UP) * PER_STEP * SAMPLES / (times[-1] - times[WARM_UP])
    path = run / "checkpoints" / "last.ckpt"
    table = torch.load(path, weights_only=True)["state_dict"]["codes.table"]
    processor = max(seconds for moment, seconds in spent if moment <= times[0])
    return Growth(times[0] - started, processor, speed, memory, table.numel() * 4, path.stat().st_size)


def watched(command: list[str]) -> tuple[list[tuple[float, float]], int]:
    """Moments with the processor's seconds spent by then, and peak resident bytes, of a command."""
    process, spent, ended = subprocess.Popen(command, cwd=ROOT, stdout=sys.stderr), [], 0
    while not ended:
        ticks = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        spent.append((time.time(), sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")))
        time.sleep(0.05)
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {process.returncode}")
    return spent, usage.ru_maxrss * 1024


def imports() -> tuple[float, float]:
    """Seconds, and the processor's, that a process takes to import torch and lightning."""
    # torch imports its compiler when the first optimiser is made: every training pays for it
    spent, _ = watched([sys.executable, "-c", "import torch._dynamo, lightning.pytorch"])
    return spent[-1][0] - spent[0][0], spent[-1][1]


def draw_times(shapes: Store, *sizes: int) -> tuple[float, float]:
    """Seconds to draw a step's batch, while shapes are seen for the first time and later.

    Args:
        sizes: shapes a step, samples and surface points of each.
    """
    keep_freed_memory()  # as training does
    batches = StepBatches(list(shapes.values()), Loading(*sizes))
    seconds = []
    for step in range(2 * len(batches)):
        start = time.perf_counter()
        batches[step]
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[: len(batches)]), statistics.median(seconds[len(batches) :])


def copy_rate() -> float:
    """Bytes a second that one thread copies from memory to memory, beyond its caches."""
    source = np.ones(2**28, np.uint8)
    target, seconds = np.zeros_like(source), []
    for _ in range(5):
        start = time.perf_counter()
        np.copyto(target, source)
        seconds.append(time.perf_counter() - start)
    return len(source) / statistics.median(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=100, help="a multiple of 100")
    parser.add_argument("--real", type=int, default=20, help="shapes to prepare; the others are copies")
    parser.add_argument("--keep", action="store_true", help="leave the store for the next time")
    arguments = parser.parse_args()
    shapes = filled_store(arguments.real)
    try:
        report(shapes, arguments)
    finally:
        if not arguments.keep:
            shutil.rmtree(FOLDER)


def report(shapes: Store, arguments: argparse.Namespace) -> None:
    """Measures and prints."""
    trained(COUNTS[0], arguments.steps)  # compiles what is compiled once and kept
    found, alone = {count: [] for count in COUNTS}, []
    for _ in range(arguments.rounds):
        alone.append(imports())
        for count in COUNTS:
            found[count].append(trained(count, arguments.steps))
    size = sum(shape.path.stat().st_size for shape in shapes.values())
    print(f"Store: {len(shapes)} shapes, {size / 1e9:.1f} GB; {arguments.real} prepared, the others copies.")
    head("shapes | start-up s | of the processor | samples/s | memory GB | codes MB | checkpoint MB")
    for count, runs in found.items():
        middle = {name: statistics.median(getattr(run, name) for run in runs) for name in vars(runs[0])}
        cells = f"{middle['start_up']:.2f}", f"{middle['processor']:.2f}", f"{middle['speed']:,.0f}"
        sizes = f"{middle['memory'] / 1e9:.3f}", f"{middle['codes'] / 1e6:.3f}"
        row(count, *cells, *sizes, f"{middle['checkpoint'] / 1e6:.2f}")
    first, later = draw_times(shapes, PER_STEP, SAMPLES, SURFACE)
    step = statistics.median(PER_STEP * SAMPLES / run.speed for run in found[COUNTS[-1]])
    clock, processor = (statistics.median(column) for column in zip(*alone, strict=True))
    print(f"\nImporting torch and lightning alone: {clock:.2f} s, {processor:.2f} s of the processor.")
    when = f"{first * 1e3:.2f} ms when they are first seen, {later * 1e3:.2f} ms later"
    print(f"Drawing a batch from {len(shapes)} shapes: {when}, of a step's {step * 1e3:.1f} ms.")
    _, seconds = draw_times(shapes, *PAPER_STEP)
    rate = PAPER_STEP[0] * (PAPER_STEP[1] * 16 + PAPER_STEP[2] * 24) / seconds
    share = f"{rate / 1e9:.2f} GB/s, {rate / copy_rate():.2f} of the rate of a copy"
    print(f"Drawing a batch of the paper's: {seconds * 1e3:.1f} ms, {share}.")


if __name__ == "__main__":
    main()
