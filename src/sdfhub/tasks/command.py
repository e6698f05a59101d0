"""The console command `sdfhub TASK key=value ...`: one Hydra app per task."""

import gc
import importlib
import os
import sys

import sdfhub

TASKS = {
    "train": "learns a shape space: sdfhub train activation=hosc encoding=fourier",
    "prepare": "makes samples ahead of time: sdfhub prepare data=open category=chairs",
    "evaluate": "judges a finished run again: sdfhub evaluate RUN evaluate.resolution=512",
    "export": "one file of a space, or its meshes: sdfhub export RUN safetensors",
    "interpolate": "shapes between two: sdfhub interpolate RUN ID ID steps=8",
    "sample": "new shapes of a space: sdfhub sample RUN n=8",
    "neighbours": "the shapes most like one: sdfhub neighbours RUN ID (or a scan)",
    "view": "a page on this machine to see, move, mix and fit shapes: sdfhub view RUN",
    "import-deepsdf": "an experiment of DeepSDF's code becomes a run: sdfhub import-deepsdf EXPERIMENT_DIR",
    "reconstruct": "finds the shapes behind scans: sdfhub reconstruct RUN scan.ply",
    "report": "tables and a page from a sweep's folder: sdfhub report outputs/sweeps/table_small",
}


def main() -> None:
    """Runs the task that the first argument names with the rest of the command line."""
    task = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if task not in TASKS and "LOCAL_RANK" in os.environ:
        # Lightning starts the further processes of a training with the words that are left of its own
        sys.argv.insert(1, task := "train")
    if task in ("-h", "--help"):
        print("usage: sdfhub TASK [key=value ...]; sdfhub TASK --help tells its keys\n")
        print("\n".join(f"  {name:<16}{about}" for name, about in TASKS.items()))
        return
    if task == "--version":
        print(f"sdfhub {sdfhub.__version__}")
        return
    if task not in TASKS:
        print(f"sdfhub: error: there is no task {task!r}; choose {', '.join(TASKS)}", file=sys.stderr)
        sys.exit(2)
    del sys.argv[1]
    gc.disable()  # what imports make stays: looking it over for garbage is a fifth of a start
    module = importlib.import_module(f"sdfhub.tasks.{task.replace('-', '_')}")
    gc.freeze()
    gc.enable()
    module.main()
