"""DeepSDF's published training step, written anew from its description: its network, loss and data path.

    python benchmarks/reference.py THREADS SAMPLES FILE.npz ...

makes a step at each line of input and answers with a line. So run it is what DeepSDF's users run: a process
of its own, with PyTorch as it comes, which knows nothing of sdfhub and what that does to memory and threads.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.nn.utils.parametrizations import weight_norm


class ReferenceDecoder(nn.Module):
    """DeepSDF's network: 8 hidden layers of 512, input re-injected at the fourth, the code at every point."""

    def __init__(self, code_size: int = 256, width: int = 512, depth: int = 8, again: int = 4):
        super().__init__()
        given = code_size + 3
        sizes = [given] + [width] * depth
        layers = []
        for index in range(depth):
            emitted = width - given if index + 1 == again else width
            layers.append(weight_norm(nn.Linear(sizes[index], emitted)))
        self.layers, self.again = nn.ModuleList(layers), again
        self.head = nn.Linear(width, 1)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Signed distances [P, 1] of inputs [P, L + 3]."""
        x = inputs
        for index, layer in enumerate(self.layers):
            if index == self.again:
                x = torch.cat([x, inputs], dim=1)
            x = F.dropout(F.relu(layer(x)), 0.2, self.training)
        return torch.tanh(self.head(x))


class ReferenceStep:
    """One step of DeepSDF's published training, which knows no bfloat16; by `bf16` its products have it."""

    def __init__(self, files: list[Path], samples: int, device: torch.device, bf16: bool = False):
        self.files, self.samples, self.device, self.bf16 = files, samples, device, bf16
        self.decoder = ReferenceDecoder().to(device)
        self.codes = nn.Embedding(len(files), 256, max_norm=1.0).to(device)
        self.parts = 1 if device.type == "cpu" else 4
        self.waiting = None if device.type == "cpu" else self._read()
        nn.init.normal_(self.codes.weight, 0, 1 / 16)
        groups = [
            {"params": self.decoder.parameters(), "lr": 5e-4},
            {"params": self.codes.parameters(), "lr": 1e-3},
        ]
        self.optimizer = torch.optim.Adam(groups)

    def _load(self, file: Path) -> torch.Tensor:
        """[N, 4] samples of one shape: half outside, half inside, without rows that are not numbers."""
        drawn = []
        with np.load(file) as arrays:
            for name in ("pos", "neg"):
                rows = torch.from_numpy(arrays[name])
                rows = rows[~rows[:, 3].isnan()]
                drawn.append(rows[(torch.rand(self.samples // 2) * len(rows)).long()])
        return torch.cat(drawn)

    def _read(self) -> torch.Tensor:
        """[B * N, 4] samples of all shapes."""
        return torch.cat([self._load(file) for file in self.files]).to(self.device)

    def __call__(self) -> None:
        rows = self._read() if self.waiting is None else self.waiting
        which = torch.arange(len(self.files), device=self.device).repeat_interleave(self.samples)
        self.optimizer.zero_grad()
        for some, of_shapes in zip(rows.chunk(self.parts), which.chunk(self.parts), strict=True):
            target = some[:, 3:].clamp(-0.1, 0.1)
            codes = self.codes(of_shapes)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
                predicted = self.decoder(torch.cat([codes, some[:, :3]], dim=1))
            predicted = predicted.float().clamp(-0.1, 0.1)
            loss = F.l1_loss(predicted, target, reduction="sum") / len(rows)
            loss = loss + 1e-4 * codes.norm(dim=1).sum() / len(rows)
            loss.backward()
        self.optimizer.step()


class ReferenceProcess:
    """The step in a process of its own. It sleeps between its steps."""

    def __init__(self, files: list[Path], samples: int, threads: int):
        command = [sys.executable, __file__, str(threads), str(samples), *map(str, files)]
        self.bf16 = False
        # sdfhub has set this one when it was imported, and a child would inherit it
        plain = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
        self.process = subprocess.Popen(
            command,
            env=plain,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is the benchmark's; this process ends when its input does
        )

    def __call__(self) -> None:
        """Makes a step.

        Raises:
            OSError: the process has ended.
        """
        print(file=self.process.stdin, flush=True)
        if not self.process.stdout.readline():
            raise BrokenPipeError("the process of DeepSDF's step has ended; what it said stands above")

    def close(self) -> None:
        """Ends the process."""
        self.process.communicate()


def answer(threads: str, samples: str, *files: str) -> None:
    """Makes a step whenever it is asked to."""
    torch.set_num_threads(int(threads))
    step = ReferenceStep([Path(file) for file in files], int(samples), torch.device("cpu"))
    for _ in sys.stdin:
        step()
        print("done", flush=True)


if __name__ == "__main__":
    answer(*sys.argv[1:])
