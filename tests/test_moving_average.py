"""`--policy.ema_decay`: an average of the weights acts, those of the last update learn; both are saved and resumed."""

import shutil

import numpy as np
import pytest
import torch
from test_flat_weights import TINY, root, run, train  # noqa: F401  (root is a fixture)
from test_policy_contract import make_config, make_episode, make_policy, step_through
from test_policy_training import batch_of

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

pytestmark = pytest.mark.usefixtures("one_thread")

DECAY, N_UPDATES = 0.7, 40  # the decay has risen to its final value by then


def learn(policy, n_updates, rate=1e-2, after=lambda: None):
    policy.train()
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=rate)
    for _ in range(n_updates):
        policy.forward(batch_of(policy))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        after()
    return policy.eval()


def numbers_of(network):
    return {name: value.double().numpy() for name, value in network.state_dict().items() if value.is_floating_point()}


def actions_of(policy):
    return step_through(policy, [make_episode(3, policy.config)])


def test_weights_and_statistics_are_averaged_as_the_formula_says():
    policy = make_policy(n_supervised_steps=1, ema_decay=DECAY)
    seen = []
    learn(policy, N_UPDATES, after=lambda: seen.append({k: np.array(v) for k, v in numbers_of(policy.model).items()}))

    wanted = seen[0]
    for n, weights in enumerate(seen[1:], start=1):
        decay = min(DECAY, (1 + n) / (10 + n))
        wanted = {name: decay * wanted[name] + (1 - decay) * weights[name] for name in wanted}
    averaged = numbers_of(policy.acting_network)
    assert averaged.keys() == wanted.keys()
    assert any("running_mean" in name for name in wanted)
    assert any("spectrogram" in name for name in wanted)
    for name, value in wanted.items():
        np.testing.assert_allclose(averaged[name], value, rtol=1e-4, atol=1e-5)
    assert any(np.abs(averaged[name] - seen[-1][name]).max() > 1e-3 for name in averaged)


def test_the_average_acts_and_the_last_weights_learn():
    policy = learn(make_policy(n_supervised_steps=1, ema_decay=DECAY), 5)
    plain = make_policy(n_supervised_steps=1)
    plain.model.load_state_dict(policy.acting_network.state_dict())
    last = make_policy(n_supervised_steps=1)
    last.model.load_state_dict(policy.model.state_dict())

    acted = actions_of(policy)
    assert torch.equal(acted, actions_of(plain))
    assert not torch.allclose(acted, actions_of(last), atol=1e-3)
    batch = batch_of(policy)
    with torch.no_grad():
        assert torch.equal(policy.forward(batch)[0], plain.forward(batch)[0])  # a held-out loss is that of what acts
        torch.manual_seed(0)
        learning = policy.train().forward(batch)[0]
        torch.manual_seed(0)
        assert torch.equal(learning, last.train().forward(batch)[0])


def test_learning_is_what_it_is_without_an_average():
    averaged = learn(make_policy(n_supervised_steps=1, ema_decay=DECAY), 5)
    plain = learn(make_policy(n_supervised_steps=1), 5)
    for name, value in plain.model.state_dict().items():
        assert torch.equal(averaged.model.state_dict()[name], value)
    assert not any(parameter.requires_grad for parameter in averaged.averaged.parameters())


def test_a_checkpoint_holds_both_and_each_can_act(tmp_path):
    policy = learn(make_policy(n_supervised_steps=1, ema_decay=DECAY), 5)
    policy.save_pretrained(tmp_path)
    again = PlaybyearPolicy.from_pretrained(tmp_path)
    assert torch.equal(actions_of(again), actions_of(policy))
    for name, value in policy.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)

    last = PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(n_supervised_steps=1), strict=True)
    assert last.averaged is None
    for name, value in policy.model.state_dict().items():
        assert torch.equal(last.model.state_dict()[name], value)


def test_an_average_can_begin_at_a_checkpoint_that_has_none(tmp_path):
    plain = learn(make_policy(n_supervised_steps=1), 3)
    plain.save_pretrained(tmp_path)
    policy = PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(n_supervised_steps=1, ema_decay=DECAY))
    assert torch.equal(actions_of(policy), actions_of(plain))
    learn(policy, 1)
    for name, value in policy.model.state_dict().items():
        assert torch.equal(policy.acting_network.state_dict()[name], value)  # the first update counts whole


def test_an_average_that_lacks_weights_is_refused(tmp_path):
    make_policy(use_audio=False, ema_decay=DECAY).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="does not fit"):
        PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(ema_decay=DECAY))


@pytest.mark.parametrize("decay", [-0.1, 1.0, 1.5])
def test_a_decay_that_is_none_is_refused(decay):
    with pytest.raises(ValueError, match=r"--policy.ema_decay must be at least 0 \(none\) and below 1"):
        make_config(ema_decay=decay)


def test_a_resumed_training_ends_with_the_same_average(tmp_path, root):  # noqa: F811
    options = [
        *TINY,
        "--policy.ema_decay=0.9",
        f"--dataset.root={root}",
        "--dataset.repo_id=test/noise",
        "--save_freq=2",
    ]
    run(train, *options, "--steps=4", f"--output_dir={tmp_path / 'whole'}")
    checkpoints = shutil.copytree(tmp_path / "whole", tmp_path / "parts", symlinks=True) / "checkpoints"
    shutil.rmtree(checkpoints / "000004")
    (checkpoints / "last").unlink()
    (checkpoints / "last").symlink_to("000002")
    config = checkpoints / "last/pretrained_model/train_config.json"
    run(train, "--resume=true", f"--config_path={config}", f"--output_dir={tmp_path / 'parts'}")
    whole = PlaybyearPolicy.from_pretrained(tmp_path / "whole/checkpoints/000004/pretrained_model")
    resumed = PlaybyearPolicy.from_pretrained(tmp_path / "parts/checkpoints/000004/pretrained_model")
    assert whole.averaged.n_averaged == resumed.averaged.n_averaged == 4
    for name, value in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name
