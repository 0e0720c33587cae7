"""Other distributions, installed for a test: the examples' wheels, and what a test writes."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

_EXAMPLES = Path(__file__).parents[2] / "examples"
_BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


def install_example(name: str, site: Path) -> None:
    """Builds the wheel of an example and unpacks it where Python finds distributions, as an installer does."""
    folder = site.parent / f"{name}_built"
    shutil.copytree(_EXAMPLES / name, folder)
    subprocess.run([sys.executable, "-c", _BUILD, str(folder)], cwd=folder, check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(site)


def install(name: str, site: Path, code: str | None = None, entry_points: str = "") -> None:
    """A distribution of one module at most."""
    info = site / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    if code is not None:
        (site / f"{name}.py").write_text(code)


def longest_file(name: str) -> int:
    """Lines of the longest file of an example."""
    files = [path for ending in ("py", "toml") for path in (_EXAMPLES / name).rglob(f"*.{ending}")]
    return max(len(path.read_text().splitlines()) for path in files)
