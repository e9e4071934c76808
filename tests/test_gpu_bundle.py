"""Wheels cut into small folders are the same wheels when joined; what is missing or damaged is named in one line."""

import json
import re
import shutil
import zipfile

import pytest

from experiments.benchmarks import gpu_bundle
from experiments.benchmarks.gpu_bundle import Chunk, cut
from experiments.commandline.arguments import UsageError


@pytest.fixture
def bundle(tmp_path):
    """A bundle of two files of 25 and 10 bytes, in folders of 12 bytes."""
    (tmp_path / "wheels").mkdir()
    (tmp_path / "wheels" / "a.whl").write_bytes(bytes(range(25)))
    (tmp_path / "wheels" / "b.whl").write_bytes(b"0123456789")
    gpu_bundle.pack(tmp_path / "wheels", tmp_path / "bundle", most=12)
    return tmp_path / "bundle"


def test_a_large_wheel_continues_in_the_next_folder():
    assert cut({"a": 25, "b": 10}, 12) == [
        Chunk(1, "a", 0, 12),
        Chunk(2, "a", 12, 12),
        Chunk(3, "a", 24, 1),
        Chunk(3, "b", 0, 10),
    ]
    assert cut({"a": 12, "b": 1}, 12) == [Chunk(1, "a", 0, 12), Chunk(2, "b", 0, 1)]


def test_folders_that_arrived_in_several_places_are_joined(bundle, tmp_path):
    shutil.move(bundle / "2", tmp_path / "elsewhere")
    joined = tmp_path / "joined"
    joined.mkdir()
    found = gpu_bundle.unpack([tmp_path / "elsewhere", bundle], joined)
    assert [path.name for path in found] == ["a.whl", "b.whl"]
    assert [path.read_bytes() for path in found] == [bytes(range(25)), b"0123456789"]


def test_what_is_wrong_is_named(bundle, tmp_path):
    with pytest.raises(UsageError, match="^FOLDER: expects also the folders 1, 3 of the bundle$"):
        gpu_bundle.unpack([bundle / "2"], tmp_path)
    with pytest.raises(UsageError, match="^FOLDER: expects a folder that `pack` wrote, not "):
        gpu_bundle.unpack([tmp_path / "wheels"], tmp_path)
    manifest = json.loads((bundle / "3" / "manifest.json").read_text())
    manifest["wheels"]["a.whl"] = "0" * 64
    (bundle / "3" / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(UsageError, match="^FOLDER: expects folders of one bundle, not of several$"):
        gpu_bundle.unpack([bundle], tmp_path)


def test_a_damaged_chunk_is_named(bundle, tmp_path):
    (bundle / "2" / "a.whl.12").write_bytes(bytes(12))
    with pytest.raises(UsageError, match="^FOLDER: expects .*/2/a.whl.12 as it was packed; its SHA-256 differs$"):
        gpu_bundle.unpack([bundle], tmp_path)


def test_the_command_installs_a_bundle(tmp_path, capsys):
    name = "little-1.0.dist-info"
    (tmp_path / "wheels").mkdir()
    with zipfile.ZipFile(tmp_path / "wheels" / "little-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("little.py", "value = 7\n")
        wheel.writestr(f"{name}/METADATA", "Metadata-Version: 2.1\nName: little\nVersion: 1.0\n")
        wheel.writestr(f"{name}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{name}/RECORD", "")
    gpu_bundle.pack(tmp_path / "wheels", tmp_path / "bundle", most=100)
    site = tmp_path / "site"
    assert gpu_bundle.main(["unpack", str(tmp_path / "bundle"), str(site)]) == 0
    assert (site / "little.py").read_text() == "value = 7\n"
    assert gpu_bundle.main(["unpack", str(tmp_path / "bundle"), str(site)]) == 2
    assert capsys.readouterr().err == f"SITE: expects a new folder, not {site}\n"


def test_every_package_has_one_version_in_the_constraints():
    pinned = {re.split("==", line)[0].lower() for line in gpu_bundle.CONSTRAINTS.read_text().splitlines()}
    names = [name.lower() for group in gpu_bundle.PACKAGES.values() for name in group]
    assert {*names} <= pinned and len({*names}) == len(names)
