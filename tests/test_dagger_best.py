"""`checkpoints/best` of playbyear-dagger: the weights of the best evaluation, which are kept until a better one comes."""

import shutil

import pytest
from dagger_factory import QUICK, PowerCut, command, dagger, metrics, state

from lerobot_playbyear.dagger.run_folder import RunFolder
from lerobot_playbyear.training.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")

RUN = (*QUICK, "--warmup_episodes=1", "--eval_every=2", "--eval.n_episodes=1")


@pytest.fixture
def gives(monkeypatch):
    """Says what the next evaluations will give [%]."""
    rates: list[float] = []

    def evaluate(*_):
        return {"overall": {"pc_success": rates.pop(0), "n_episodes": 1}}

    monkeypatch.setattr(Learner, "evaluate", evaluate)
    return rates


def test_the_best_evaluation_keeps_its_weights(tmp_path, gives, monkeypatch, capfd):
    checkpoints = tmp_path / "out/checkpoints"

    def go_on(*options):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", *options)
        assert gives == []
        return (checkpoints / "best").resolve(), (checkpoints / "last").resolve()

    def cut_after_the_best(folder, state, clean=RunFolder.clean):
        if state.best.get("success") == 60:
            raise PowerCut
        clean(folder, state)

    gives += [10, 30, 60]
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "clean", cut_after_the_best)
        with pytest.raises(PowerCut):
            dagger(tmp_path, *RUN, "--episodes=3")  # evaluated after 0, 2 and 3 attempts
    third = (checkpoints / state(tmp_path)["checkpoint"]).resolve()
    gives += [20, 50]
    best, last = go_on("--episodes=5")
    assert (best, last.name) == (third, state(tmp_path)["checkpoint"])
    assert (best / "pretrained_model/model.safetensors").is_file()  # though it is no milestone
    assert best != last
    assert f"Best:        60.0 % of them: {checkpoints / 'best/pretrained_model'}" in capfd.readouterr().out

    gives += [60, 50]  # of equal ones the last
    best, last = go_on("--episodes=7")
    assert best not in (third, last)
    assert not third.exists()
    shutil.rmtree(best)  # to make room
    gives += [40]
    capfd.readouterr()
    best, last = go_on("--episodes=8")
    assert best == last
    assert "Best:" not in capfd.readouterr().out


def test_the_policy_that_a_run_began_with_may_be_the_best_and_other_episodes_are_evaluated(tmp_path, gives, capfd):
    gives += [30, 20]
    dagger(tmp_path, *RUN, "--episodes=1")
    assert not (tmp_path / "out/checkpoints/best").is_symlink()
    assert f"Best:        30.0 % of them: {state(tmp_path)['policy_path']}" in capfd.readouterr().out
    gives += [40]
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--eval.n_episodes=2")
    assert "Success:     40.0 % of 2 episodes" in capfd.readouterr().out
    assert [line["pc_success"] for line in metrics(tmp_path, "eval")] == [30, 20, 40]
