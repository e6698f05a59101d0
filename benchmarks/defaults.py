"""The defaults at scale=cpu against DeepSDF in the same training time, side by side on this machine.

    python benchmarks/defaults.py [more overrides for every run]

Trains fft_hosc and fft_siren as they are; measures an epoch of DeepSDF; trains DeepSDF for as many epochs
as fit into the longer of the two times. All 20 meshes of ours are judged, the first 8 of DeepSDF's, at 128^3:
its decoder takes half a minute a shape there. Prints a Markdown table; CD, floor and excess times 10^3.
"""

import sys

from runs import HEAD, row, train


def main(overrides: list[str]) -> None:
    common = ["scale=cpu", "evaluate=fast", "callbacks=none", "data.held_out=0", *overrides]
    ours = {name: train(name, *common, f"experiment={name}") for name in ("fft_hosc", "fft_siren")}
    seconds = max(metrics["training"]["seconds"] for metrics in ours.values())
    short = train("deepsdf_short", *common, "experiment=deepsdf", "trainer.max_epochs=1", "evaluate.known=0")
    epochs = max(1, round(seconds / (short["training"]["seconds"])))
    longer = ["experiment=deepsdf", f"trainer.max_epochs={epochs}", "evaluate.known=8"]
    rows = ours | {"deepsdf": train("deepsdf", *common, *longer)}
    print(HEAD)
    print("\n".join(row(name, metrics) for name, metrics in rows.items()), flush=True)
    excess = {name: metrics["known"]["summary"]["excess"]["mean"] for name, metrics in rows.items()}
    for name in ours:
        print(f"deepsdf / {name}, mean excess of known shapes: {excess['deepsdf'] / excess[name]:.1f}")


if __name__ == "__main__":
    main(sys.argv[1:])
