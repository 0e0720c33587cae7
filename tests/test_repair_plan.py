"""What a repair plans follows from the survey alone: no file is needed to try it."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.episodes import Episode
from lerobot_playbyear.datasets.repair.frames import DataFile, Run
from lerobot_playbyear.datasets.repair.plan import make_plan
from lerobot_playbyear.datasets.repair.report import RepairReport
from lerobot_playbyear.datasets.repair.survey import Survey
from lerobot_playbyear.datasets.repair.tasks import Tasks

LENGTH = 5
NOWHERE = Path("nowhere")


def whole(number: int, **changes) -> Episode:
    file = DataFile(Path("data/chunk-000/file-000.parquet"), NOWHERE, is_whole=True, n_rows=4 * LENGTH)
    run = Run(file, number * LENGTH, LENGTH, number, 0, number * LENGTH, True, (0,))
    return Episode(number, replace(run, **changes), {"episode_index": number, "length": LENGTH})


def lost(number: int) -> Episode:
    return Episode(number, reason="its frames are lost")


def survey(*episodes: Episode, tables_are_right: bool = True, splits: dict[str, str] | None = None) -> Survey:
    info = DatasetInfo("v3.0", 20, {}, len(episodes), LENGTH * len(episodes), splits=splits or {})
    tasks = Tasks(pd.DataFrame({"task_index": [0]}, index=["Listen."]), note=None)
    rows = [episode.row for episode in episodes]
    return Survey(RepairReport(NOWHERE), info, {}, rows, tables_are_right, episodes, tasks, {})


def test_of_a_sound_dataset_everything_stays():
    plan = make_plan(survey(*map(whole, range(4))))
    assert [(kept.number, kept.first_index, kept.frames_stay) for kept in plan.kept] == [
        (number, LENGTH * number, True) for number in range(4)
    ]
    assert plan.tables_stay
    assert not plan.survey.report.dropped
    assert not plan.notes
    assert plan.survey.report.is_sound


def test_episodes_after_a_lost_one_move_up_and_the_counts_and_splits_with_them():
    plan = make_plan(survey(whole(0), lost(1), whole(2), whole(3), splits={"train": "0:3", "val": "3:4"}))
    assert [(kept.run.episode, kept.number, kept.first_index) for kept in plan.kept] == [
        (0, 0, 0),
        (2, 1, 5),
        (3, 2, 10),
    ]
    assert [kept.frames_stay for kept in plan.kept] == [True, False, False]
    assert plan.survey.report.dropped == {1: "its frames are lost"}
    assert plan.survey.report.kept == {0: 0, 2: 1, 3: 2}
    assert (plan.info.total_episodes, plan.info.total_frames) == (3, 15)
    assert plan.info.splits == {"train": "0:2", "val": "2:3"}
    assert len(plan.notes) == 2
    assert not plan.tables_stay


def test_a_row_that_is_lost_or_a_table_that_is_damaged_has_the_tables_made_anew():
    without_row = replace(whole(1), row={})
    assert not make_plan(survey(whole(0), without_row)).tables_stay
    assert not make_plan(survey(whole(0), tables_are_right=False)).tables_stay
    assert make_plan(survey(whole(0))).tables_stay


def test_frames_that_are_not_numbered_one_after_the_other_are_numbered_anew():
    plan = make_plan(survey(whole(0), whole(1, is_numbered=False)))
    assert [kept.frames_stay for kept in plan.kept] == [True, False]
    assert not plan.survey.report.dropped


def test_a_report_tells_what_is_proven_from_what_is_not():
    assert not RepairReport(NOWHERE, findings=["It is damaged."]).is_sound
    assert not RepairReport(NOWHERE, undecided=["It may be."]).is_sound
    odd = RepairReport(NOWHERE, odd=["It is odd."])
    assert odd.is_sound
    assert "It is odd." in str(odd)
