"""Real recordings for tests: in the folder that SURECUT_DATA names, or in `shared/data` beside the repository."""

import os
from pathlib import Path

import pytest


def real_data(name: str) -> Path:
    """A file or folder of the real data; the test is skipped, with the reason, where it is absent."""
    root = Path(__file__).resolve().parents[1]
    places = [root.parent / "shared" / "data", root.parents[1] / "shared" / "data"]
    if given := os.environ.get("SURECUT_DATA"):
        places = [Path(given)]
    for place in places:
        if (place / name).exists():
            return place / name
    pytest.skip(f"real data {name} is not in {places[0]}; set SURECUT_DATA to the folder that holds it")
