"""Nothing stays on the CPU when training, fitting and meshing move to a GPU: see `tests/twin_gpu.py`."""

import subprocess
import sys


def test_all_that_runs_on_a_gpu_stays_there():
    done = subprocess.run(
        [sys.executable, "-m", "tests.twin_gpu"], capture_output=True, text=True, timeout=280
    )
    control, *jobs = done.stdout.splitlines()
    assert "found at least two devices" in control, done.stderr  # a mistake would be seen
    left = [line for line in jobs if not line.endswith("stays on the device")]
    assert not left and len(jobs) == 4 * 6, done.stdout
