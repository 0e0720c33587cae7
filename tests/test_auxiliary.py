"""What learns better than the paper's policy: displacements, envelopes, losses beside the action's; off by default."""

import math

import pytest
import torch
from support.policy import MICROPHONE, STATE, make_config, make_episode, run_ending_at, step_through
from training_digest import probe, trained

from lerobot_playbyear.policy.auxiliary import AuxiliaryHeads, onsets, ways_from_onsets
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

pytestmark = pytest.mark.usefixtures("one_thread")

TRAINED = {"d1a39e5a6f87a521": "631d2639934b140c"}
"""By the probe of a machine: what the usual options trained there."""

N_FRAMES = 16
LEFT, RIGHT = (f"observation.audio.{side}" for side in ("left", "right"))
SMALL = {"audio_window_s": 0.9, "n_memory_steps": 3, "n_supervised_steps": 5, "n_frame_stack": 2}
HEADS = {"auxiliary_onset": 0.1, "auxiliary_balance": 0.1, "auxiliary_way": 0.1}
INPUTS = {"audio_envelope_gain": 0.3, "memory_displacement_gain": 10.0, "memory_readers": 2}
INPUTS |= {"low_dimensional_offset": 0.1}


def make_policy(**options) -> PlaybyearPolicy:
    """A small policy that has seen one batch."""
    torch.manual_seed(0)
    policy = PlaybyearPolicy(make_config(**(SMALL | options))).train()
    with torch.no_grad():
        policy.forward(batch_of(policy, seed=9))
    return policy


def batch_of(policy, seed=1, last=N_FRAMES - 1):
    return run_ending_at(make_episode(seed, policy.config, N_FRAMES), last, policy.config)


def losses_of(policy, batch, encodings, outputs):
    """Errors and weights of every head."""
    config = policy.config
    waves = [batch[key][:, -config.n_audio_frames :] / 32768 for key in config.audio_keys]
    return list(policy.model.auxiliary(waves, [batch[STATE][:, -config.n_run_frames :]], encodings, outputs).values())


def test_with_the_usual_options_training_is_what_it_was_bit_for_bit():
    if probe() not in TRAINED:
        pytest.skip(f"no digest for this machine ({probe()}): python tests/training_digest.py")
    assert trained() == TRAINED[probe()]


@pytest.mark.parametrize("name", INPUTS)
def test_stepping_equals_training_windows(name):
    wanted = {"memory_readers": ("memory_displacement_gain", "memory_readers")}.get(name, (name,))
    policy = make_policy(**{option: INPUTS[option] for option in wanted}).eval()
    episode = make_episode(1, policy.config, N_FRAMES)
    with torch.no_grad():
        stepped = step_through(policy, [episode])
    for last in (2, N_FRAMES - 1):  # the first windows begin before the episode
        predicted = policy.act_from(policy.memory_run(run_ending_at(episode, last, policy.config)))
        n = min(policy.config.n_supervised_steps, last + 1)
        torch.testing.assert_close(predicted[:, -n:], stepped[:, last + 1 - n : last + 1], atol=1e-5, rtol=0)


def test_a_checkpoint_keeps_it_all_and_one_with_heads_acts_without_them(tmp_path):
    policy = make_policy(**HEADS, **INPUTS).eval()
    policy.save_pretrained(tmp_path)
    again = PlaybyearPolicy.from_pretrained(tmp_path, strict=True)
    assert all(getattr(again.config, name) == value for name, value in (HEADS | INPUTS).items())
    bare = PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(**SMALL, **INPUTS))
    assert bare.model.auxiliary is None
    episode = make_episode(2, policy.config, 6)
    for other in (again, bare):
        assert torch.equal(step_through(other, [episode]), step_through(policy, [episode]))


# What else the network reads


def test_an_offset_moves_all_frames_of_an_item_by_the_same():
    policy = make_policy(low_dimensional_offset=0.5, use_vision=False, use_audio=False)
    batch = batch_of(policy)
    n_frames = policy.config.n_run_frames
    felt = policy.model._feel(batch, STATE, n_frames).unflatten(0, (-1, n_frames))
    moved = felt - policy.config.low_dimensional_gain * batch[STATE][:, -n_frames:]
    torch.testing.assert_close(moved, moved[:, :1].expand_as(moved), atol=1e-5, rtol=0)
    assert moved[:, 0].std() > 0.5  # drawn for every item and number


def test_an_envelope_keeps_how_loud_it_was():
    """Brought to the same size, the encodings of a faint and of a loud click are nearly the same."""
    policy = make_policy(audio_envelope_gain=0.3).eval()
    n = policy.config.n_segments
    heard = []
    for factor in (1, 4):
        episode = clicks(policy, {})
        episode[MICROPHONE][15, 300:340] += 2000 * factor
        heard += policy.model._hear_all(run_ending_at(episode, 15, policy.config), 2)
    faint, loud = (one.detach() for one in heard)
    louder = (loud - faint)[:, -n:] / 0.3
    assert louder[0].abs().max() < 1e-4  # the frame before
    assert louder[1, :-3].abs().max() < 1e-4
    spread = policy.model.spectrogram["audio_gripper"].variance.sqrt()
    assert float(louder[1, -1]) == pytest.approx(float((1.2 / spread).mean()), rel=0.1)  # 12 dB, in deviations of a bin


# Heads


@pytest.mark.parametrize("kind", ["onset", "way"])
def test_a_head_changes_the_loss_by_its_weight_and_its_gradient_reaches_the_senses(kind):
    policy = make_policy(**{f"auxiliary_{kind}": 0.1}, use_vision=False)
    batch = batch_of(policy)
    loss, figures = policy.forward(batch)
    torch.testing.assert_close(loss, figures["loss_action"] + 0.1 * figures[f"loss_{kind}"])
    network = policy.model
    encodings = network.encode_run(batch, policy.config.n_run_frames)
    outputs = network.memory_head.recall(encodings)
    ((error, _),) = losses_of(policy, batch, encodings[:, -outputs.shape[1] :], outputs)
    policy.zero_grad()
    error.sum().backward()
    assert next(iter(network.hearing.parameters())).grad.abs().max() > 0
    assert all(parameter.grad is None for parameter in network.memory_head.head.parameters())


def test_heads_are_used_neither_for_a_held_out_loss_nor_to_act():
    policy = make_policy(**HEADS).eval()
    for module in policy.modules():
        if isinstance(module, AuxiliaryHeads):
            module.register_forward_pre_hook(lambda *_: pytest.fail("a head was asked"))
    with torch.no_grad():
        assert policy.forward(batch_of(policy))[1] == {}
        step_through(policy, [make_episode(3, policy.config, 3)])


def test_sample_weights_get_every_part_of_the_loss_per_item():
    policy = make_policy(auxiliary_onset=0.5, auxiliary_way=0.5, use_vision=False)
    policy.keep_normalization()
    one, other = batch_of(policy, 1), batch_of(policy, 2, last=3)
    both = {key: torch.cat([one[key], other[key]]) for key in one}
    losses, _ = policy.forward(both, reduction="none")
    for loss, batch in zip(losses, (one, other), strict=True):
        torch.testing.assert_close(policy.forward(batch)[0], loss, rtol=1e-4, atol=1e-5)


def clicks(policy, clicked):
    """An episode of faint noise with a click in some frames, a tenth as loud at the other microphone: {frame: microphone}."""
    episode = make_episode(1, policy.config, N_FRAMES)
    generator = torch.Generator().manual_seed(1)
    for key in policy.config.audio_keys:
        sound = 30 * torch.randn(N_FRAMES, 800, generator=generator)
        for frame, loudest in clicked.items():
            sound[frame, 300:340] += 8000 if key == loudest else 800
        episode[key] = sound.to(torch.int16)
    return episode


def levels_of(policy, episode):
    sound = run_ending_at(episode, N_FRAMES - 1, policy.config)[MICROPHONE] / 32768
    return torch.log10(sound.square().mean(dim=2) + 1e-10).unsqueeze(2)


def test_an_onset_is_a_click_and_neither_what_rings_on_nor_steady_noise_nor_what_swells():
    policy = make_policy()

    def heard(episode):  # in frames 11 to 15
        return onsets(levels_of(policy, episode), 5).tolist()

    assert heard(clicks(policy, dict.fromkeys((12, 13, 15), MICROPHONE))) == [[0, 1, 0, 0, 1]]
    steady = clicks(policy, {})
    assert heard(steady | {MICROPHONE: steady[MICROPHONE] * 40}) == [[0] * 5]
    for k, frame in enumerate(range(12, 16), start=1):  # 7 dB louder each, over the threshold all the same
        steady[MICROPHONE][frame] = (steady[MICROPHONE][frame] * 2.2**k).to(torch.int16)
    assert heard(steady) == [[0] * 5]
    steady[MICROPHONE][14] = steady[MICROPHONE][11]  # what comes after a pause is one
    assert heard(steady) == [[0, 0, 0, 0, 1]]


def test_the_way_is_from_the_last_onset_that_the_memory_holds():
    policy = make_policy()  # three frames of memory
    places = torch.arange(N_FRAMES * 1.0).square()[None, -7:, None].expand(1, 7, 7) * 0.03
    twice, once = (clicks(policy, dict.fromkeys(frames, MICROPHONE)) for frames in ((11, 14), (11,)))
    ways, is_known = ways_from_onsets(levels_of(policy, twice), places, 3)
    assert is_known.tolist() == [[1, 1, 1, 1, 1]]
    assert ways[0, :, 0].tolist() == pytest.approx([0, -0.69, -1, 0, -0.87], abs=1e-5)  # frames 11 to 15; -1.44 is far
    assert ways_from_onsets(levels_of(policy, once), places, 3)[1].tolist() == [[1, 1, 1, 0, 0]]


def test_the_balance_is_who_hears_an_onset_louder_and_needs_two_ears():
    policy = PlaybyearPolicy(
        make_config(microphones=("left", "right"), use_vision=False, auxiliary_balance=1.0, **SMALL)
    )
    batch = run_ending_at(clicks(policy, {12: LEFT, 15: RIGHT}), N_FRAMES - 1, policy.config)
    head = policy.model.auxiliary.heads["balance"]
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    encodings = torch.zeros(1, 5, policy.config.embedding_size)

    def errors(logits):
        head[-1].bias.data = torch.tensor(logits)
        ((error, weight),) = losses_of(policy, batch, encodings, encodings)
        assert weight.tolist() == [[0, 1, 0, 0, 1]]  # of frames 11 to 15
        return error[0, [1, 4]].tolist()

    for_left, for_right = errors([math.log(100.0), 0.0])  # the click is 20 dB louder there
    assert for_left < 0.02 < 3 < for_right
    assert errors([0.0, math.log(100.0)]) == pytest.approx([for_right, for_left], abs=0.05)
    assert make_policy(auxiliary_balance=1.0).model.auxiliary is None


def test_nothing_has_to_be_told_of_what_the_reference_microphone_hears():
    """It is encoded by nothing: a head that had to tell it would guess."""
    policy = make_policy(microphones=("left", "right", "room"), reference_microphone="room", **HEADS)
    seen = []
    policy.model.auxiliary.register_forward_pre_hook(lambda _, inputs: seen.extend(inputs[0]))
    batch = batch_of(policy)
    policy.forward(batch)
    heard = [batch[key][:, -policy.config.n_audio_frames :] / 32768 for key in policy.config.audio_keys]
    assert [any(torch.equal(wave, own) for wave in seen) for own in heard] == [True, True, False]  # left, right, room
    assert policy.model.auxiliary.heads["balance"][-1].out_features == 2
