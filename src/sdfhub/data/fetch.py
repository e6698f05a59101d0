"""Fetches the open meshes: `python -m sdfhub.data.fetch [--root data/open]`.

On Debian and Ubuntu apt-get downloads the two packages, without root and without installing them. Elsewhere
put the two .deb files, or the folders unpacked from them, into the root by hand and run this again.
"""

import argparse
import logging
import lzma
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

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
                    archive = _archive(root, package) or _download(package, Path(scratch), root)
                    unpacked = Path(scratch) / "unpacked"
                    count = unpack(archive, unpacked, suffix)
                    os.rename(unpacked, root / package)
                    log.info("%s: %d files in %s", package, count, root / package)


def unpack(archive: Path, folder: Path, suffix: str) -> int:
    """Unpacks a .deb's regular files that end in `suffix`, and its copyright file; returns their number."""
    count, total = 0, 0
    try:
        with _data_tar(archive) as stream, tarfile.open(fileobj=stream, mode="r|") as tar:
            for member in tar:
                path = PurePosixPath(member.name)
                is_inside = member.isreg() and not path.is_absolute() and ".." not in path.parts
                if not is_inside or (path.suffix.lower() != suffix and path.name != "copyright"):
                    continue
                total += member.size
                if member.size > MAX_MEMBER or total > MAX_TOTAL:
                    raise SdfhubError(f"{archive}: {member.name} is larger than anything expected of it")
                tar.extract(member, folder, filter="data")
                count += 1
    except (tarfile.TarError, lzma.LZMAError, EOFError, ValueError) as error:
        what = f"{archive}: not a whole .deb ({error}); delete it and download it again"
        raise SdfhubError(what) from error
    if not count:
        raise SdfhubError(f"{archive}: holds no {suffix} files; is it the right package?")
    return count


@contextmanager
def _data_tar(archive: Path) -> Iterator[IO[bytes]]:
    """The uncompressed data.tar of a .deb as a stream."""
    if shutil.which("dpkg-deb"):  # reads every compression that Debian and Ubuntu use
        command = ["dpkg-deb", "--fsys-tarfile", str(archive)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            assert process.stdout
            yield process.stdout
            while process.stdout.read(1 << 20):  # the padding after the last member
                pass
        if process.returncode:
            raise ValueError(f"dpkg-deb ended with status {process.returncode}")
        return
    with archive.open("rb") as file:
        name, size = file.read(8), 0
        while not name.startswith(b"data.tar"):  # the last member
            file.seek(size + size % 2, os.SEEK_CUR)
            header = file.read(60)
            if header[58:] != b"`\n":
                raise ValueError("no data.tar in it")
            name, size = header[:16].strip(b" /"), int(header[48:58])
        if not name.endswith(b".xz"):
            raise SdfhubError(f"{archive}: needs dpkg-deb; take Debian's package, not Ubuntu's")
        with lzma.open(file) as stream:
            yield stream


def _archive(folder: Path, package: str) -> Path | None:
    return max(folder.glob(f"{package}*.deb"), default=None)


def _download(package: str, scratch: Path, root: Path) -> Path:
    """Downloads a package by apt-get into `scratch`, with package lists of our own where there are none."""
    problem = "this is no Debian or Ubuntu"
    if shutil.which("apt-get"):
        problem = "apt-get fails"
        (scratch / "lists" / "partial").mkdir(parents=True)
        private = ["-o", f"Dir::State::Lists={scratch / 'lists'}", "-o", f"Dir::Cache={scratch}"]
        for command in (["download", package], [*private, "update"], [*private, "download", package]):
            # apt hands downloads to a user of its own, who may not enter our folder
            command = ["apt-get", "-q", "-o", "APT::Sandbox::User=", *command]
            done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
            if archive := _archive(scratch, package):
                return archive
            problem = next((line for line in done.stderr.splitlines() if line.startswith("E:")), problem)
    files = " and ".join(f"{name}_*_all.deb" for name in PACKAGES)
    advice = f"get {files} from Debian's package pages, put them into {root} and run this again"
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
