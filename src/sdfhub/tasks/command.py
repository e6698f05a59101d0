"""The console command `sdfhub TASK key=value ...`: one Hydra app per task."""

import gc
import importlib
import os
import sys

import sdfhub

# the keys that a task's words without `=` stand for, and what it does: the function of its name, in the
# module of its name or in `gallery`, with the YAML of its name in conf/ (`train`: config.yaml)
TASKS = {
    "train": ("", "learns a shape space: sdfhub train activation=hosc encoding=fourier"),
    "prepare": ("", "makes samples ahead of time: sdfhub prepare data=open category=chairs"),
    "evaluate": ("run", "judges a finished run again: sdfhub evaluate RUN evaluate.resolution=512"),
    "export": ("run to", "one file of a space, or its meshes: sdfhub export RUN safetensors"),
    "interpolate": ("run a b", "shapes between two: sdfhub interpolate RUN ID ID steps=8"),
    "sample": ("run", "new shapes of a space: sdfhub sample RUN n=8"),
    "neighbours": ("run of", "the shapes most like one: sdfhub neighbours RUN ID (or a scan)"),
    "view": ("run", "a page on this machine to see, move, mix and fit shapes: sdfhub view RUN"),
    "import-deepsdf": ("folder", "a run of DeepSDF becomes ours: sdfhub import-deepsdf EXPERIMENT"),
    "reconstruct": ("run scans...", "finds the shapes behind scans: sdfhub reconstruct RUN scan.ply"),
    "report": ("sweep", "tables and a page of a sweep: sdfhub report outputs/sweeps/table_small"),
}


def main() -> None:
    """Runs the task that the first argument names with the rest of the command line."""
    task = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if task not in TASKS and "LOCAL_RANK" in os.environ:
        # Lightning starts the further processes of a training with the words that are left of its own
        sys.argv.insert(1, task := "train")
    if task in ("-h", "--help"):
        print("usage: sdfhub TASK [key=value ...]; sdfhub TASK --help tells its keys\n")
        print("\n".join(f"  {name:<16}{about}" for name, (_, about) in TASKS.items()))
        return
    if task == "--version":
        print(f"sdfhub {sdfhub.__version__}")
        return
    if task not in TASKS:
        print(f"sdfhub: error: there is no task {task!r}; choose {', '.join(TASKS)}", file=sys.stderr)
        sys.exit(2)
    del sys.argv[1]
    name = task.replace("-", "_")
    module = "gallery" if name in ("interpolate", "sample", "neighbours") else name
    gc.disable()  # what imports make stays: looking it over for garbage is a fifth of a start
    from sdfhub.tasks.app import run_task

    function = getattr(importlib.import_module(f"sdfhub.tasks.{module}"), name)
    gc.freeze()
    gc.enable()
    run_task(function, "config" if task == "train" else name, TASKS[task][0].split())
