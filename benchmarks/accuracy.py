"""What speed costs in accuracy: the same training written plainly, as sdfhub computes it, and in bfloat16.

    python benchmarks/accuracy.py [--seeds 3] [overrides for every run]

Trains experiment=fft_hosc at scale=tiny (8 chairs, 1600 steps) with equal seeds, data and steps: by
plain_training.py, by train.py in float32 and with trainer.precision=bf16-mixed; all are judged in float32.
Prints the training shapes' CD times 10^3 and its excess over the floor, and what the mean CD is to that of
the plain training; seeds differ in weights and order of samples, so their spread is the noise that a ratio
has to be read against. One floating crumb, decided by rounding, makes a mean and leaves the median.
"""

import argparse
import statistics

from runs import head, row, train

PLAIN = "plain, float32"
WAYS = {
    PLAIN: ("benchmarks/plain_training.py", "32-true"),
    "float32": ("train.py", "32-true"),
    "bf16-mixed": ("train.py", "bf16-mixed"),
}
"""Script and precision of each."""
COLUMNS = [("cd", "mean"), ("cd", "median"), ("excess", "mean"), ("excess", "median")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    common = ["scale=tiny", "experiment=fft_hosc", "callbacks=none", "data.held_out=0", *args.overrides]
    scores = "CD, mean | CD, median | excess, mean | excess, median"
    head(f"seed | training | {scores} | mean CD to the plain one's")
    found: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    for seed in range(args.seeds):
        for way, (script, precision) in WAYS.items():
            words = [*common, f"seed={seed}", f"trainer.precision={precision}"]
            summary = train("accuracy", *words, script=script)["train"]["summary"]
            found[way].append([summary[score][name] * 1e3 for score, name in COLUMNS])
            line(seed, way, found[way][-1], found[PLAIN][-1])
    means = {way: [statistics.mean(column) for column in zip(*found[way], strict=True)] for way in WAYS}
    for way in WAYS:
        line("mean of seeds", way, means[way], means[PLAIN])


def line(seed: object, way: str, values: list[float], plain: list[float]) -> None:
    row(seed, way, *(f"{value:.4f}" for value in values), f"{values[0] / plain[0]:.3f}")


if __name__ == "__main__":
    main()
