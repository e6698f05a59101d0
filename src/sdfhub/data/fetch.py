"""Fetches the open meshes: `python -m sdfhub.data.fetch [--root data/open]`.

On Debian and Ubuntu apt-get downloads the two packages, without root and without installing them. Elsewhere
put the two .deb files, or the folders unpacked from them, into the root by hand and run this again.
"""

import argparse
import io
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


def fetch(root: str | Path) -> None:
    """Puts the meshes of both packages below `root`; what is there already stays.

    Raises:
        SdfhubError: a package is neither there nor can be downloaded; says which files to put where.
    """
    root = Path(root)
    root.mkdir(parents=True, exist_ok=True)
    with locked(root / ".lock", waiting=f"{root}: waiting for another process that fetches"):
        for leftover in root.glob(".fetch-*"):  # of a run that was killed
            shutil.rmtree(leftover, ignore_errors=True)
        for package, suffix in PACKAGES.items():
            if any(root.rglob(f"*{suffix}")):
                continue
            with tempfile.TemporaryDirectory(prefix=".fetch-", dir=root) as scratch:
                archive = _archive_by_hand(root, package) or _download(package, Path(scratch), root)
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
                target, content = folder.joinpath(*path.parts), tar.extractfile(member)
                assert content, "a regular file"
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    shutil.copyfileobj(content, file)
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
            shutil.copyfileobj(process.stdout, io.BytesIO())  # the padding after the last member
        if process.returncode:
            raise ValueError(f"dpkg-deb ended with status {process.returncode}")
        return
    with archive.open("rb") as file:
        if file.read(8) != b"!<arch>\n":
            raise ValueError("no ar archive")
        name, size = "", 0
        while not name.startswith("data.tar"):  # the last member
            file.seek(size + size % 2, os.SEEK_CUR)
            header = file.read(60)
            if header[58:] != b"`\n":
                raise ValueError("no data.tar in it")
            name, size = header[:16].decode("ascii", "replace").strip().rstrip("/"), int(header[48:58])
        if not name.endswith(".xz"):
            raise SdfhubError(f"{archive}: {name} needs dpkg-deb; take Debian's package, not Ubuntu's")
        with lzma.open(file) as stream:
            yield stream


def _archive_by_hand(root: Path, package: str) -> Path | None:
    return next(iter(sorted(root.glob(f"{package}*.deb"), reverse=True)), None)


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
            if archive := _archive_by_hand(scratch, package):
                return archive
            problem = next((line for line in done.stderr.splitlines() if line.startswith("E:")), problem)
    files = " and ".join(f"{name}_*_all.deb" for name in PACKAGES)
    advice = f"get {files} from Debian's package pages, put them into {root} and run this again"
    raise SdfhubError(f"{package} is not in {root} and cannot be downloaded ({problem}); {advice}")


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m sdfhub.data.fetch", description=fetch.__doc__)
    parser.add_argument("--root", default="data/open", help="where the meshes go (default: %(default)s)")
    root = parser.parse_args(arguments).root
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        fetch(root)
    except (SdfhubError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
