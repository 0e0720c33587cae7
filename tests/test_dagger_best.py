"""`checkpoints/best` of playbyear-dagger: the weights of the best evaluation, kept for good."""

import pytest
from dagger_factory import QUICK, command, dagger, state

from lerobot_playbyear.training.parts import TrainingParts

pytestmark = pytest.mark.usefixtures("one_thread")

RUN = (*QUICK, "--warmup_episodes=1", "--eval_every=2", "--eval.n_episodes=1", "--eval.batch_size=1")


@pytest.fixture
def gives(monkeypatch):
    """Says what the next evaluations will give [%]."""
    rates: list[float] = []

    def evaluate(*_):
        return {"overall": {"pc_success": rates.pop(0), "n_episodes": 1}}

    monkeypatch.setattr(TrainingParts, "evaluate", evaluate)
    return rates


def test_the_best_evaluation_keeps_its_weights(tmp_path, gives, capfd):
    checkpoints = tmp_path / "out/checkpoints"

    def linked():
        assert gives == []
        return {name: (checkpoints / name).resolve().name for name in ("best", "last")}

    gives += [10, 30, 60]
    dagger(tmp_path, *RUN, "--episodes=3")  # evaluated after 0, 2 and 3 attempts
    third = state(tmp_path)["checkpoint"]
    assert linked() == {"best": third, "last": third}
    assert "Best:" not in capfd.readouterr().out

    gives += [20, 50]
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=5")
    assert linked() == {"best": third, "last": state(tmp_path)["checkpoint"]}
    assert (checkpoints / "best/pretrained_model/model.safetensors").is_file()  # though it is no milestone
    assert f"Best:        60.0 % of them: {checkpoints / 'best/pretrained_model'}" in capfd.readouterr().out

    gives += [60]  # of equal ones the last, and of other seeds every one
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=6")
    assert linked()["best"] == linked()["last"] == state(tmp_path)["checkpoint"]
    gives += [40]
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--episodes=7", "--eval.n_episodes=2")
    assert linked()["best"] == linked()["last"] == state(tmp_path)["checkpoint"]


def test_the_policy_that_a_run_began_with_may_be_the_best(tmp_path, gives, capfd):
    gives += [30, 20, 10]
    dagger(tmp_path, *RUN, "--episodes=3")
    assert not (tmp_path / "out/checkpoints/best").is_symlink()
    assert f"Best:        30.0 % of them: {state(tmp_path)['policy_path']}" in capfd.readouterr().out
