"""The log's tables are those that `experiments.report` makes of the committed results."""

import pytest

from experiments.report import in_log, report


@pytest.mark.slow
def test_the_tables_of_the_log_are_those_of_the_results():
    assert in_log() == report(), "run `python -m experiments.report --write`"
