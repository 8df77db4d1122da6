"""Campaigns: many runs with seeds, one file each, resumable; then one table over all of them."""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ..estimator.executor import Executor, Outcome
from ..factors.errors import SurecutError
from .campaign_pixels import LOG
from .campaign_row import Row, failed_row
from .campaign_run import Level, RunOrder, run
from .measurement_level_scenario import load_scenarios
from .scenario import load_scenarios as load_pixel_scenarios

SCENARIOS = Path(__file__).parent / "campaign_scenarios"
RUNS = "runs"
SETTINGS = "campaign.json"


@dataclass(frozen=True, slots=True)
class Campaign:
    """What is run. A folder belongs to one campaign: its settings are written there and must not change."""

    level: Level
    scenarios: tuple[Mapping[str, Any], ...]
    """Run i takes scenario i modulo their number."""
    leave_out: bool = False
    decisions: bool = False
    sensitivity: bool = False
    recordings: Path | None = None
    """Folder that keeps the rendered recordings, to run a later estimator on the same ones."""
    mounts_anew: bool = False
    """With images: the rig's mount is drawn anew for every run, so that a recording serves several times."""

    def order(self, number: int) -> RunOrder:
        """The order of one run."""
        scenario = self.scenarios[number % len(self.scenarios)]
        return RunOrder(
            number,
            self.level,
            scenario,
            self.leave_out,
            self.decisions,
            self.sensitivity,
            self.recordings,
            self.mounts_anew,
        )


def open_campaign(
    source: str,
    level: Level,
    leave_out: bool = False,
    decisions: bool = False,
    sensitivity: bool = False,
    recordings: Path | None = None,
    mounts_anew: bool = False,
) -> Campaign:
    """A campaign from a scenario file or the name of one that comes with surecut; images also from a folder of
    simulated recordings.

    Raises:
        SurecutError: there is no such scenario, or something in it is wrong.
    """
    if mounts_anew and level != "pixels":
        raise SurecutError("mounts are drawn anew for recordings only: every run of measurements draws its own")
    if recordings is not None:
        recordings.mkdir(parents=True, exist_ok=True)
    if level == "pixels":
        found = _recorded(Path(source)) if Path(source).is_dir() else _rendered(source)
    else:
        path = Path(source) if Path(source).suffix in (".yaml", ".yml") else SCENARIOS / f"{source}.yaml"
        if not path.exists():
            names = ", ".join(sorted(one.stem for one in SCENARIOS.glob("*.yaml")))
            raise SurecutError(f"{source}: no such scenario; give a YAML file or one of {names}")
        found = tuple(scenario.model_dump(mode="json") for scenario in load_scenarios(path))
    return Campaign(level, found, leave_out, decisions, sensitivity, recordings, mounts_anew)


def _rendered(source: str) -> tuple[Mapping[str, Any], ...]:
    return tuple(scenario.model_dump(mode="json") for scenario in load_pixel_scenarios(source))


def _recorded(folder: Path) -> tuple[Mapping[str, Any], ...]:
    """Simulated recordings that are there already: they carry their truth."""
    logs = sorted(folder.glob("*.mcap"))
    if not logs:
        raise SurecutError(f"{folder}: holds no recordings (*.mcap)")
    return tuple({"name": log.stem, LOG: str(log.resolve())} for log in logs)


def run_campaign(
    folder: Path,
    campaign: Campaign,
    runs: int,
    executor: Executor,
    done: Callable[[int], None] = lambda count: None,
) -> list[Row]:
    """Runs 0 to runs - 1, less those whose file is there already.

    Args:
        folder: results; made if it is not there.
        campaign: what to run.
        runs: how many.
        executor: where.
        done: called with the number of runs that were there already, then with 1 for each that comes.

    Returns:
        All rows, by number.

    Raises:
        SurecutError: the folder belongs to another campaign.
    """
    claim_folder(folder, campaign)
    missing = [number for number in range(runs) if not _file(folder, number).exists()]
    done(runs - len(missing))
    for outcome in executor.run(run, [campaign.order(number) for number in missing]):
        row = _row(outcome)
        write_whole(_file(folder, row["run"]), json.dumps(row))
        done(1)
    return read_rows(folder, range(runs))


def claim_folder(folder: Path, campaign: Campaign) -> None:
    """Writes the settings, or checks that they are those of an earlier call."""
    (folder / RUNS).mkdir(parents=True, exist_ok=True)
    settings = {
        "level": campaign.level,
        "scenarios": [dict(scenario) for scenario in campaign.scenarios],
        "leave_out": campaign.leave_out,
        "decisions": campaign.decisions,
        **({"sensitivity": True} if campaign.sensitivity else {}),
        **({"mounts_anew": True} if campaign.mounts_anew else {}),
    }
    path = folder / SETTINGS
    if path.exists():
        if json.loads(path.read_text()) != json.loads(json.dumps(settings)):
            raise SurecutError(f"{folder}: holds a campaign with other settings; give another folder or empty it")
        return
    write_whole(path, json.dumps(settings, indent=1))


def read_rows(folder: Path, numbers: Iterable[int]) -> list[Row]:
    """The rows that are there."""
    return [json.loads(_file(folder, number).read_text()) for number in numbers if _file(folder, number).exists()]


def write_whole(path: Path, text: str) -> None:
    """A file appears only when all of it is written."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def scenario_text(campaign: Campaign) -> str:
    """The scenarios as YAML, for the record."""
    return yaml.safe_dump([dict(scenario) for scenario in campaign.scenarios], sort_keys=False)


def failures(rows: Sequence[Row]) -> list[Row]:
    """Rows without a result."""
    return [row for row in rows if row["status"] != "done"]


def _file(folder: Path, number: int) -> Path:
    return folder / RUNS / f"{number:06d}.json"


def _row(outcome: Outcome[RunOrder, Row]) -> Row:
    if outcome.value is not None:
        return outcome.value
    order = outcome.item
    return failed_row(order.number, str(order.scenario.get("name", "")), outcome.error or "no reason")
