"""Whether bfloat16 products cost accuracy: the same training in float32 and in bf16-mixed, over seeds.

    python benchmarks/accuracy.py [--seeds 3] [overrides for every run]

Trains experiment=fft_hosc at scale=demo (8 chairs, 1600 steps) with equal seeds, data and steps, judged in
float32. Prints mean and median CD times 10^3 of each run and the ratios over all seeds; seeds differ in
weights and order of samples, so their spread is the noise that a ratio has to be read against. One floating
crumb, which rounding decides about, makes a mean and leaves the median.
"""

import argparse
import statistics

from runs import at_least, run_benchmark, train

PRECISIONS = ("32-true", "bf16-mixed")
STATISTICS = ("mean", "median")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=at_least(1), default=3)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    common = ["scale=demo", "experiment=fft_hosc", "callbacks=none", "data.held_out=0", *args.overrides]
    found: dict[str, list[float]] = {f"{name}, {p}": [] for name in STATISTICS for p in PRECISIONS}
    print("| seed | " + " | ".join([*found, *(f"ratio of {name}s" for name in STATISTICS)]) + " |")
    print("| --- " * (1 + len(found) + len(STATISTICS)) + "|", flush=True)
    for seed in range(args.seeds):
        for precision in PRECISIONS:
            run = train(f"accuracy_{precision}", *common, f"seed={seed}", f"trainer.precision={precision}")
            for name in STATISTICS:
                found[f"{name}, {precision}"].append(run["known"]["summary"]["cd"][name] * 1e3)
        line(str(seed), [values[-1] for values in found.values()])
    line("mean of seeds", [statistics.mean(values) for values in found.values()])


def line(name: str, values: list[float]) -> None:
    """A row of the table: values in pairs of the precisions, then the ratio of each pair."""
    ratios = [half / full for full, half in zip(values[::2], values[1::2], strict=True)]
    cells = [f"{value:.4f}" for value in values] + [f"{ratio:.3f}" for ratio in ratios]
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    run_benchmark(main)
