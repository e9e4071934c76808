"""Brings the packages of the benchmark to a machine with JAX for CUDA and without a network.

    python -m experiments.benchmarks.gpu_bundle pack FOLDER           # here: writes FOLDER/1, FOLDER/2, ...
    python -m experiments.benchmarks.gpu_bundle unpack FOLDER SITE    # there: installs into the folder SITE

`pack` downloads the wheels of `PACKAGES` in the versions of constraints.txt and cuts them, so that each numbered folder
has at most 52 MiB and can be sent alone. `unpack` takes the numbered folders, or the folder above them, from wherever
they arrived. It checks every SHA-256, joins the wheels and installs them with pip. It needs Python and pip only.
PYTHONPATH=SITE makes Python find them.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import BAD_USAGE, UsageError

# Of one numbered folder: where 64 MiB can be sent at once, the repository's own files, 8 MiB, travel with it.
PIECE_BYTES = 52 * 2**20
MANIFEST = "manifest.json"
PYTHON = "3.12"
CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"
# What the benchmark's GPU suite and the command `run` import, and JAX (with NumPy and SciPy) does not bring.
PACKAGES = {
    "the agents": ["flax", "optax", "chex", "absl-py", "toolz", "treescope", "typing_extensions"],
    "the simulators": ["mujoco", "mujoco-mjx", "warp-lang", "etils", "trimesh"],
    "the reference environments": ["gymnasium", "cloudpickle", "Farama-Notifications", "imageio", "pillow"],
    "checkpoints": ["orbax-checkpoint", "tensorstore", "msgpack", "humanize", "simplejson", "aiofiles", "psutil"],
    "files and event files": ["flatbuffers", "protobuf", "packaging", "PyYAML", "tensorboardX"],
    "tables": ["rich", "markdown-it-py", "mdurl", "Pygments"],
    "figures": ["matplotlib", "contourpy", "cycler", "fonttools", "kiwisolver", "pyparsing", "python-dateutil"],
}
# A wheel names the oldest glibc that it works with, and pip compares names: glibc 2.5 to 2.34.
PLATFORMS = [*(f"manylinux_2_{minor}_x86_64" for minor in range(5, 35)), "manylinux2014_x86_64", "manylinux1_x86_64"]


class Chunk(NamedTuple):
    """Consecutive bytes of a wheel, in one numbered folder."""

    folder: int  # from 1
    wheel: str  # its file name
    start: int  # in the wheel
    size: int

    @property
    def file(self) -> str:
        """The name of the chunk's file."""
        return f"{self.wheel}.{self.start}"


def cut(sizes: dict[str, int], most: int) -> list[Chunk]:
    """Cuts wheels into chunks, folder after folder of `most` bytes; all folders but the last are full.

    Args:
      sizes: bytes of each wheel by its name.
    """
    chunks, folder, room = [], 1, most
    for wheel, size in sizes.items():
        start = 0
        while start < size:
            if not room:
                folder, room = folder + 1, most
            length = min(room, size - start)
            chunks.append(Chunk(folder, wheel, start, length))
            start, room = start + length, room - length
    return chunks


def download(folder: Path, python_version: str) -> None:
    """Downloads the wheels of `PACKAGES` for this Python on Linux x86-64. Raises `UsageError` with pip's last line."""
    names = [name for group in PACKAGES.values() for name in group]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    command += [f"--python-version={python_version}", "--implementation=cp"]
    command += [f"--abi={abi}" for abi in ("cp" + python_version.replace(".", ""), "abi3", "none")]
    command += [f"--platform={name}" for name in PLATFORMS]
    _run_pip([*command, f"--constraint={CONSTRAINTS}", f"--dest={folder}", *names])


def pack(wheels: Path, out: Path, most: int = PIECE_BYTES) -> list[Path]:
    """Cuts the wheels of a folder into numbered folders in `out`, each with a manifest; returns these folders."""
    paths = {path.name: path for path in sorted(wheels.glob("*.whl"))}
    chunks = cut({name: path.stat().st_size for name, path in paths.items()}, most)
    sums = {name: _sha256(path.read_bytes()) for name, path in paths.items()}
    folders = [out / str(number) for number in range(1, chunks[-1].folder + 1)]
    for number, folder in enumerate(folders, 1):
        folder.mkdir(parents=True)
        listed = []
        for chunk in (chunk for chunk in chunks if chunk.folder == number):
            with paths[chunk.wheel].open("rb") as file:
                file.seek(chunk.start)
                data = file.read(chunk.size)
            (folder / chunk.file).write_bytes(data)
            listed.append({"wheel": chunk.wheel, "start": chunk.start, "file": chunk.file, "sha256": _sha256(data)})
        manifest = {"folder": number, "folders": len(folders), "chunks": listed, "wheels": sums}
        (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return folders


def unpack(folders: Sequence[Path], wheels: Path) -> list[Path]:
    """Joins the wheels of numbered folders, or of folders above such, in the folder `wheels`; returns their paths.

    Raises:
      UsageError: a numbered folder is missing or of another bundle, or a sum is wrong.
    """
    found = [_manifest(path) for given in folders for path in _pieces(given)]
    numbers = {manifest["folder"] for _, manifest in found}
    first = found[0][1]
    if any(manifest["wheels"] != first["wheels"] for _, manifest in found):
        raise UsageError("FOLDER: expects folders of one bundle, not of several")
    if missing := {*range(1, first["folders"] + 1)} - numbers:
        raise UsageError(f"FOLDER: expects also the folders {', '.join(map(str, sorted(missing)))} of the bundle")
    for path, manifest in found:
        for chunk in manifest["chunks"]:
            data = (path / Path(chunk["file"]).name).read_bytes()
            if _sha256(data) != chunk["sha256"]:
                raise UsageError(f"FOLDER: expects {path / chunk['file']} as it was packed; its SHA-256 differs")
            joined = wheels / Path(chunk["wheel"]).name
            with joined.open("r+b" if joined.exists() else "w+b") as file:
                file.seek(chunk["start"])
                file.write(data)
    for name, expected in first["wheels"].items():
        if _sha256((wheels / Path(name).name).read_bytes()) != expected:
            raise UsageError(f"FOLDER: expects the chunks of {name} as they were packed; its SHA-256 differs")
    return [wheels / Path(name).name for name in first["wheels"]]


def install(wheels: Sequence[Path], site: Path) -> None:
    """Installs wheels into the folder `site`. Raises `UsageError` with pip's last line."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile"]
    _run_pip([*command, f"--target={site}", *map(str, wheels)])


def _pieces(folder: Path) -> list[Path]:
    """A numbered folder itself, or those in a folder."""
    if (folder / MANIFEST).is_file():
        return [folder]
    if pieces := sorted(path.parent for path in folder.glob(f"*/{MANIFEST}")):
        return pieces
    raise UsageError(f"FOLDER: expects a folder that `pack` wrote, not {folder}")


def _manifest(folder: Path) -> tuple[Path, dict[str, Any]]:
    return folder, json.loads((folder / MANIFEST).read_text())


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _run_pip(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or ["ERROR: it wrote nothing"]
        raise UsageError(f"pip: {errors[-1].removeprefix('ERROR: ')}")


def parser() -> argparse.ArgumentParser:
    """The two commands' arguments."""
    parser = argparse.ArgumentParser("python -m experiments.benchmarks.gpu_bundle", allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True)
    packing = commands.add_parser("pack", help="download the wheels and cut them into numbered folders")
    packing.add_argument("folder", type=Path, metavar="FOLDER")
    packing.add_argument("--python_version", default=PYTHON, help=f"of the other machine; default: {PYTHON}")
    unpacking = commands.add_parser("unpack", help="check, join and install them")
    unpacking.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    unpacking.add_argument("site", type=Path, metavar="SITE")
    return parser


def main(argv: Sequence[str]) -> int:
    """The two commands; returns the exit code."""
    options = parser().parse_args(argv)
    target = options.folder if options.command == "pack" else options.site
    try:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise UsageError(f"{'FOLDER' if options.command == 'pack' else 'SITE'}: expects a new folder, not {target}")
        with tempfile.TemporaryDirectory() as temporary:
            wheels = Path(temporary)
            if options.command == "pack":
                download(wheels, options.python_version)
                for folder in pack(wheels, target):
                    size = sum(path.stat().st_size for path in folder.iterdir())
                    print(f"{folder}: {size / 2**20:.1f} MiB")
            else:
                install(unpack(options.folders, wheels), target)
                print(f"installed; PYTHONPATH={target} makes Python find the packages")
    except UsageError as error:
        print(error, file=sys.stderr)
        return BAD_USAGE
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
