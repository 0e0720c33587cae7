"""What a repair plans follows from the survey alone: no file is needed to try it."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.data_file import DataFile
from lerobot_playbyear.datasets.repair.dataset_statistics import OwnStats
from lerobot_playbyear.datasets.repair.episodes import Episode
from lerobot_playbyear.datasets.repair.findings import Finding, State, Thing
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.plan import make_plan
from lerobot_playbyear.datasets.repair.report import describe
from lerobot_playbyear.datasets.repair.survey import Survey
from lerobot_playbyear.datasets.repair.tasks import Tasks

LENGTH = 5
NOWHERE = Path("nowhere")


def whole(number: int, **changes) -> Episode:
    file = DataFile(Path("data/chunk-000/file-000.parquet"), NOWHERE, is_whole=True, n_rows=4 * LENGTH)
    run = Run(file, number * LENGTH, LENGTH, number, 0, number * LENGTH, True, (0,))
    return Episode(number, State.FINE, replace(run, **changes), {"episode_index": number, "length": LENGTH})


def lost(number: int) -> Episode:
    return Episode(number, State.MISSING, reason="its frames are lost")


def survey(*episodes: Episode, findings: tuple[Finding, ...] = (), splits: dict[str, str] | None = None) -> Survey:
    info = DatasetInfo("v3.0", 20, {}, len(episodes), LENGTH * len(episodes), splits=splits or {})
    tasks = Tasks(pd.DataFrame({"task_index": [0]}, index=["Listen."]), True, False, ())
    return Survey(info, {}, tuple(episode.row for episode in episodes), episodes, tasks, OwnStats({}, ()), findings)


def test_of_a_sound_dataset_everything_stays():
    plan = make_plan(survey(*map(whole, range(4))))
    assert [(kept.number, kept.first_index, kept.frames_stay) for kept in plan.kept] == [
        (number, LENGTH * number, True) for number in range(4)
    ]
    assert plan.tables_stay
    assert not plan.dropped
    assert not plan.notes
    assert describe(NOWHERE, plan).is_sound


def test_episodes_after_a_lost_one_move_up_and_the_counts_and_splits_with_them():
    plan = make_plan(survey(whole(0), lost(1), whole(2), whole(3), splits={"train": "0:3", "val": "3:4"}))
    assert [(kept.run.episode, kept.number, kept.first_index) for kept in plan.kept] == [
        (0, 0, 0),
        (2, 1, 5),
        (3, 2, 10),
    ]
    assert [kept.frames_stay for kept in plan.kept] == [True, False, False]
    assert plan.dropped == {1: "its frames are lost"}
    assert (plan.info.total_episodes, plan.info.total_frames) == (3, 15)
    assert plan.info.splits == {"train": "0:2", "val": "2:3"}
    assert len(plan.notes) == 2
    assert not plan.tables_stay


def test_a_row_that_is_lost_or_a_table_that_is_damaged_has_the_tables_made_anew():
    without_row = replace(whole(1), row={})
    assert not make_plan(survey(whole(0), without_row)).tables_stay
    damage = Finding(Thing.TABLE, State.DAMAGED, "a table cannot be read")
    assert not make_plan(survey(whole(0), findings=(damage,))).tables_stay
    assert make_plan(survey(whole(0), findings=(replace(damage, thing=Thing.STATISTICS),))).tables_stay


def test_frames_that_are_not_numbered_one_after_the_other_are_numbered_anew():
    plan = make_plan(survey(whole(0), whole(1, is_numbered=False)))
    assert [kept.frames_stay for kept in plan.kept] == [True, False]
    assert not plan.dropped


def test_a_report_tells_what_is_proven_from_what_is_not():
    states = {state: Finding(Thing.INFO, state, state.name.lower()) for state in State}
    report = describe(NOWHERE, make_plan(survey(whole(0), findings=tuple(states.values()))))
    assert report.findings == ["damaged", "missing"]
    assert (report.undecided, report.odd) == (["undecided"], ["odd"])
    only = {
        state: describe(NOWHERE, make_plan(survey(whole(0), findings=(finding,)))) for state, finding in states.items()
    }
    assert [only[state].is_sound for state in (State.DAMAGED, State.MISSING, State.UNDECIDED, State.ODD)] == [
        False,
        False,
        False,
        True,
    ]
    assert "odd" in str(only[State.ODD])
