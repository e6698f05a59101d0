"""Whether bfloat16 products cost accuracy: the same training in float32 and in bf16-mixed, over seeds.

    python benchmarks/accuracy.py [--seeds 3] [overrides for every run]

Trains experiment=fft_hosc at scale=demo (8 chairs, 1600 steps) with equal seeds, data and steps, judged in
float32. Prints mean CD times 10^3 of each run and the ratio of the means over all seeds; seeds differ in
weights and order of samples, so their spread is the noise that the ratio has to be read against.
"""

import argparse
import statistics

from runs import train

PRECISIONS = ("32-true", "bf16-mixed")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    common = ["scale=demo", "experiment=fft_hosc", "callbacks=none", "data.held_out=0", *args.overrides]
    means: dict[str, list[float]] = {precision: [] for precision in PRECISIONS}
    print("| seed | " + " | ".join(PRECISIONS) + " | ratio |\n| --- | --- | --- | --- |", flush=True)
    for seed in range(args.seeds):
        for precision, found in means.items():
            run = train(f"accuracy_{precision}", *common, f"seed={seed}", f"trainer.precision={precision}")
            found.append(run["known"]["summary"]["cd"]["mean"] * 1e3)
        line([str(seed), *(found[-1] for found in means.values())])
    line(["mean", *(statistics.mean(found) for found in means.values())])


def line(cells: list) -> None:
    """A row of the table; the last column is the ratio of its last two cells."""
    name, full, half = cells
    print(f"| {name} | {full:.4f} | {half:.4f} | {half / full:.3f} |", flush=True)


if __name__ == "__main__":
    main()
