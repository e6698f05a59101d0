"""What optimisers, samples and losses do to known and to unseen shapes, by steps and seconds of training.

    python benchmarks/learning.py [--scale cpu] [--category lamps] [--ways adam muon] [overrides for all]

Trains each way side by side with equal seeds and shapes, for shares of the scale's epochs (`--shares`), each
with a schedule of its own. Prints the excess CD times 10^3 of training and of held-out shapes, and how many
of these have floating pieces: more connected pieces than the true mesh.
"""

import argparse
import re

import yaml
from runs import OUTPUTS, ROOT, head, row, train

from sdfhub.data.preparation.sampling import normalize_mesh
from sdfhub.geometry.surface import piece_count
from sdfhub.procedural import generate


def loading(shapes: int, samples: int, passes: int) -> list[str]:
    """A step's shapes and samples of each, a quarter as many surface points, and passes an epoch."""
    counts = {"shapes_per_step": shapes, "samples_per_shape": samples, "passes_per_epoch": passes}
    return [f"scale.normal_points={samples // 4}", *(f"data.loader.{k}={n}" for k, n in counts.items())]


NEAR = ["loss.far_weight=1", "data.preparation.near_share=0.94"]  # as in the paper
FAR = ["loss.far_weight=5", "data.preparation.near_share=0.8"]
DECOYS = ["data.preparation.decoy_share=0.1"]
WAYS = {
    "adam": ["optimizer=adam", *NEAR],
    "adam, decoys": ["optimizer=adam", *NEAR, *DECOYS],
    "adam, far": ["optimizer=adam", *FAR],
    "muon": ["optimizer=muon", *NEAR],
    "muon, decoys": ["optimizer=muon", *NEAR, *DECOYS],
    "muon, far": ["optimizer=muon", *FAR],
    "muon, decoys, far": ["optimizer=muon", *FAR, *DECOYS],
    "muon, rotated": ["optimizer=muon", *NEAR, "encoding=rotated"],
    "soap": ["optimizer=soap", *NEAR],
    "soap, far": ["optimizer=soap", *FAR],
    "as the scale has it": [],
    "no normals": ["normals=off"],
    "film": ["conditioning=film"],
    "4 x 192": ["decoder.width=192", "decoder.depth=4", "decoder.inject_code=[1,2,3]"],
    "2 octaves": ["scale.frequencies=2"],
    "4 octaves": ["scale.frequencies=4"],
    "codes of 128": ["decoder.code_size=128"],
    "codes' rate 3e-2": ["scale.lr_codes=3e-2"],
    "decoys": DECOYS,
    "averaged weights": [
        "+callbacks.ema._target_=lightning.pytorch.callbacks.EMAWeightAveraging",
        "+callbacks.ema.decay=0.99",
    ],
    "25 shapes of 128 samples": loading(25, 128, 10),
    "50 shapes of 64 samples": loading(50, 64, 10),
    "50 shapes of 128 samples": loading(50, 128, 10),
    "100 shapes of 32 samples": loading(100, 32, 20),
}


def floating(shapes: list[dict]) -> str:
    """How many have more pieces than the true mesh, of how many with a surface, and how many have none."""
    found = [shape for shape in shapes if not shape["failed"]]
    more = 0
    for shape in found:
        category, index = shape["id"].split("/")
        mesh = normalize_mesh(*generate(category, int(index)))
        more += shape["pieces"] > piece_count(mesh.faces, len(mesh.vertices))
    return f"{more} of {len(found)} | {len(shapes) - len(found)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", default="cpu")
    parser.add_argument("--category", default="chairs")
    parser.add_argument("--experiment", default="fft_siren")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["adam", "muon", "muon, far"])
    parser.add_argument("--shares", nargs="+", type=float, default=[1.0], help="of the scale's epochs")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    epochs = yaml.safe_load((ROOT / "conf/scale" / f"{args.scale}.yaml").read_text())["trainer"]["max_epochs"]
    scores = "known, mean | median | unseen, mean | median | floating pieces | no surface"
    head(f"training | seed | steps | s | {scores}")
    for share in args.shares:
        for seed in range(args.seeds):
            for way in args.ways:
                words = [f"scale={args.scale}", f"experiment={args.experiment}", f"category={args.category}"]
                words += [f"seed={seed}", f"trainer.max_epochs={max(1, round(share * epochs))}"]
                name = "learning_" + re.sub(r"\W+", "_", way)
                found = train(name, *words, "callbacks=none", *WAYS[way], *args.overrides)
                cells = [found["training"]["steps"], f"{found['training']['seconds']:.0f}"]
                for role in ("train", "held_out"):
                    excess = found[role]["summary"]["excess"]
                    cells += [f"{excess[name] * 1e3:.4f}" for name in ("mean", "median")]
                row(way, seed, *cells, floating(found["held_out"]["shapes"]))
    print(f"\nthe last training of each way: {OUTPUTS}/learning_*")


if __name__ == "__main__":
    main()
