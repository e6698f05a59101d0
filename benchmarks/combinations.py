"""Every activation x encoding x normals at scale=demo, from its defaults: does it train, and how well?

    python benchmarks/combinations.py [more overrides, such as trainer.max_epochs=5]

Prints a Markdown table of the known shapes: CD, floor and excess times 10^3, loss at start and end.
"""

import itertools
import sys

from runs import HEAD, row, train


def main(overrides: list[str]) -> None:
    print(HEAD.replace("seconds |\n", "seconds | loss start | loss end |\n") + " --- | --- |")
    grid = itertools.product(
        ["relu", "siren", "hosc"], ["none", "fourier", "gaussian", "hash"], ["on", "off"]
    )
    for activation, encoding, normals in grid:
        choice = [f"activation={activation}", f"encoding={encoding}", f"normals={normals}"]
        name = f"{activation}_{encoding}_normals-{normals}"
        try:
            metrics = train(name, "scale=demo", "data.held_out=0", "callbacks=none", *choice, *overrides)
        except RuntimeError as error:
            print(f"| {name} | failed: {error} |", flush=True)
            continue
        loss = metrics["training"]["loss"]
        print(row(name, metrics) + f" {loss['start']:.5f} | {loss['end']:.5f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
