"""Fetches the open meshes: `python -m sdfhub.data.fetch [--root data/open]`.

On Debian and Ubuntu apt-get downloads the two packages, without root and without installing them. Elsewhere
put the folders unpacked from the two .deb files into the root by hand.
"""

import argparse
import logging
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked

log = logging.getLogger(__name__)

# Debian packages and the suffix of the meshes in them; nothing else of them is unpacked
PACKAGES = {"sweethome3d-furniture": ".sh3f", "flightgear-data-ai": ".ac"}
MAX_MEMBER, MAX_TOTAL = 256 << 20, 2 << 30


def fetch(root: Path) -> None:
    """Puts the meshes of both packages below `root`; what is there already stays."""
    root.mkdir(parents=True, exist_ok=True)
    with locked(root / ".lock", waiting=f"{root}: waiting for another process that fetches"):
        for leftover in root.glob(".fetch-*"):  # of a run that was killed
            shutil.rmtree(leftover, ignore_errors=True)
        for package, suffix in PACKAGES.items():
            if not any(root.rglob(f"*{suffix}")):
                with tempfile.TemporaryDirectory(prefix=".fetch-", dir=root) as scratch:
                    archive = shutil.which("dpkg-deb") and max(root.glob(f"{package}*.deb"), default=None)
                    unpacked = Path(scratch) / "unpacked"
                    unpack(archive or _download(package, Path(scratch), root), unpacked, suffix)
                    os.rename(unpacked, root / package)
                    log.info("%s: in %s", package, root / package)


def unpack(archive: Path, folder: Path, suffix: str) -> None:
    """Unpacks a .deb's regular files that end in `suffix`, and its copyright file."""
    command, total = ["dpkg-deb", "--fsys-tarfile", str(archive)], 0
    try:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            assert process.stdout
            with tarfile.open(fileobj=process.stdout, mode="r|") as tar:
                for member in tar:
                    if member.isreg() and member.name.lower().endswith((suffix, "/copyright")):
                        total += member.size
                        if member.size > MAX_MEMBER or total > MAX_TOTAL:
                            raise ValueError(f"{member.name} is larger than anything expected of it")
                        tar.extract(member, folder, filter="data")
            while process.stdout.read(1 << 20):  # the padding after the last member
                pass
        if process.returncode:
            raise ValueError(f"dpkg-deb ended with status {process.returncode}")
    except (tarfile.TarError, ValueError) as error:
        raise SdfhubError(f"{archive}: not a whole .deb ({error}); delete it and fetch it again") from error
    if not total:
        raise SdfhubError(f"{archive}: holds no {suffix} files; is it the right package?")


def _download(package: str, scratch: Path, root: Path) -> Path:
    """Downloads a package by apt-get into `scratch`, with package lists of our own where there are none."""
    problem = "this is no Debian or Ubuntu"
    if shutil.which("apt-get"):
        (scratch / "lists" / "partial").mkdir(parents=True)
        private = ["-o", f"Dir::State::Lists={scratch / 'lists'}", "-o", f"Dir::Cache={scratch}"]
        for command in (["download", package], [*private, "update"], [*private, "download", package]):
            # apt hands downloads to a user of its own, who may not enter our folder
            command = ["apt-get", "-q", "-o", "APT::Sandbox::User=", *command]
            done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
            if archive := max(scratch.glob(f"{package}*.deb"), default=None):
                return archive
            problem = next((line for line in done.stderr.splitlines() if line.startswith("E:")), problem)
    advice = f"unpack Debian's {' and '.join(f'{name}_*_all.deb' for name in PACKAGES)} below {root} by hand"
    raise SdfhubError(f"{package} is not in {root} and cannot be downloaded ({problem}); {advice}")


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m sdfhub.data.fetch", description=fetch.__doc__)
    parser.add_argument("--root", type=Path, default="data/open", help="(default: %(default)s)")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        fetch(parser.parse_args(arguments).root)
    except (SdfhubError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
