"""What learns better than the paper's policy: displacements, envelopes, losses beside the action's; off by default."""

import math

import pytest
import torch
from test_fake_cuda import Waits, move_to_card, on_card, without_cudnn
from test_policy_contract import make_config, make_episode, run_ending_at, step_through
from torch._subclasses.fake_tensor import FakeTensorMode
from training_digest import probe, trained

from lerobot_playbyear.policy.auxiliary import AuxiliaryHeads, onsets, ways_from_onsets
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.optimization import computes_512_bits

pytestmark = pytest.mark.usefixtures("one_thread")

MICROPHONE, N_FRAMES = "observation.audio.gripper", 16
TRAINED = {"d1a39e5a6f87a521": "9d03b8ddf2f5e894", "e213f808f21bff54": "131ba9e78762b0ee"}
"""By the probe of a machine: what the usual options trained there, since pictures are shrunk before they are recoloured."""

SMALL = {"audio_window_s": 0.9, "n_memory_steps": 3, "n_supervised_steps": 5, "n_frame_stack": 2}
CANDIDATES = {
    "onset": {"auxiliary_onset": 0.1},
    "balance": {"auxiliary_balance": 0.1},
    "envelope": {"audio_envelope_gain": 0.3},
    "way": {"auxiliary_way": 0.1},
    "displacement": {"memory_displacement_gain": 10.0, "low_dimensional_offset": 0.1},
    "readers": {"memory_displacement_gain": 10.0, "memory_readers": 2},
}
EVERYTHING = {name: value for options in CANDIDATES.values() for name, value in options.items()}
HEADS = ("onset", "way")


def make_policy(**options) -> PlaybyearPolicy:
    """A small policy that has seen one batch."""
    torch.manual_seed(0)
    policy = PlaybyearPolicy(make_config(**(SMALL | options))).train()
    with torch.no_grad():
        policy.forward(batch_of(policy, seed=9))
    return policy


def batch_of(policy, seed=1, last=N_FRAMES - 1):
    return run_ending_at(make_episode(seed, policy.config, N_FRAMES), last, policy.config)


def test_with_the_usual_options_training_is_what_it_was_bit_for_bit():
    if probe() not in TRAINED:
        pytest.skip(f"no digest for this machine ({probe()}): python tests/training_digest.py")
    assert trained() == TRAINED[probe()]


def losses_of(policy, batch, encodings, outputs):
    """Errors and weights of every head."""
    config = policy.config
    waves = [batch[key][:, -config.n_audio_frames :] / 32768 for key in config.audio_keys]
    felt = [batch["observation.state"][:, -config.n_run_frames :]]
    return list(policy.model.auxiliary(waves, felt, encodings, outputs).values())


def test_the_usual_options_make_no_new_module_and_say_nothing_new():
    policy = make_policy()
    assert policy.model.auxiliary is None
    assert policy.forward(batch_of(policy))[1] == {}


@pytest.mark.parametrize("options", CANDIDATES.values(), ids=CANDIDATES)
def test_stepping_equals_training_windows(options):
    policy = make_policy(**options).eval()
    episode = make_episode(1, policy.config, N_FRAMES)
    with torch.no_grad():
        stepped = step_through(policy, [episode])
    for last in (2, N_FRAMES - 1):  # the first windows begin before the episode
        predicted = policy.predict_run(run_ending_at(episode, last, policy.config))
        n = min(policy.config.n_supervised_steps, last + 1)
        torch.testing.assert_close(predicted[:, -n:], stepped[:, last + 1 - n : last + 1], atol=1e-5, rtol=0)


def test_a_checkpoint_keeps_it_all_and_one_with_heads_acts_without_them(tmp_path):
    policy = make_policy(**EVERYTHING).eval()
    policy.save_pretrained(tmp_path)
    again = PlaybyearPolicy.from_pretrained(tmp_path, strict=True)
    assert {name: getattr(again.config, name) for name in EVERYTHING} == EVERYTHING
    episode = make_episode(2, policy.config, 6)
    assert torch.equal(step_through(again, [episode]), step_through(policy, [episode]))
    off = {name: 0.0 for name in EVERYTHING if name.startswith("auxiliary_")}
    bare = PlaybyearPolicy.from_pretrained(tmp_path, config=make_config(**(SMALL | EVERYTHING | off)))
    assert bare.model.auxiliary is None
    assert torch.equal(step_through(bare, [episode]), step_through(policy, [episode]))


@pytest.mark.slow
def test_a_training_step_with_everything_traces_as_one_graph():
    policy = make_policy(**EVERYTHING, audio_noise_db=0.0, audio_colour_db=3.0)
    batch = batch_of(policy, last=4)
    with torch._dynamo.config.patch(allow_rnn=True):
        explained = torch._dynamo.explain(lambda batch: policy.forward(batch)[0])(batch)
    assert explained.break_reasons == []
    assert (explained.graph_count, explained.graph_break_count) == (1, 0)


def test_on_a_gpu_everything_lies_on_the_card_and_the_host_never_waits():
    policy = PlaybyearPolicy(make_config(**(SMALL | EVERYTHING)))
    real = batch_of(policy, last=4)
    with FakeTensorMode():
        move_to_card(policy)
        batch = {key: on_card(value) for key, value in real.items()}
        with Waits() as waits, without_cudnn():
            loss, figures = policy.train().forward(batch)
    assert {value.device.type for value in (loss, *figures.values())} == {"cuda"}
    assert waits.lines == []


@pytest.mark.skipif(not computes_512_bits(), reason="oneDNN has no LSTM in bfloat16 for this processor")
def test_in_bfloat16_it_learns_the_same():
    """The preset `cpu` learns in it where the processor can; energies and targets stay exact."""
    losses = []
    for enabled in (False, True):
        policy = make_policy(**EVERYTHING, use_vision=False)
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            losses.append(policy.forward(batch_of(policy))[1])
    for name, value in losses[0].items():
        assert losses[1][name].dtype == torch.float32
        torch.testing.assert_close(losses[1][name], value, rtol=0.05, atol=0.01)


# Displacement


def test_an_offset_moves_all_frames_of_an_item_by_the_same():
    policy = make_policy(low_dimensional_offset=0.5, use_vision=False, use_audio=False)
    batch = batch_of(policy)
    n_frames = policy.config.n_run_frames
    felt = policy.model._feel(batch, "observation.state", n_frames).unflatten(0, (-1, n_frames))
    true = policy.config.low_dimensional_gain * batch["observation.state"][:, -n_frames:]
    moved = felt - true
    torch.testing.assert_close(moved, moved[:, :1].expand_as(moved), atol=1e-5, rtol=0)
    assert moved[:, 0].std() > 0.5  # drawn for every item and number
    policy.eval()
    torch.testing.assert_close(policy.model._feel(batch, "observation.state", n_frames), true.flatten(0, 1))


def test_the_memory_knows_how_far_away_something_was_and_not_where():
    policy = make_policy(memory_displacement_gain=10.0).eval()
    head, n_fused = policy.model.memory_head, policy.config.embedding_size
    frames = torch.randn(2, policy.config.memory_steps, head.lstm.input_size)
    elsewhere = frames.clone()
    elsewhere[..., n_fused:] += 3.0  # the whole window at another place
    torch.testing.assert_close(head(elsewhere), head(frames), atol=1e-5, rtol=0)
    further = frames.clone()
    further[:, 0, n_fused:] += 3.0  # only what is remembered
    assert (head(further) - head(frames)).abs().max() > 1e-3


def test_displacements_are_in_normalised_units_times_their_gain():
    policy = make_policy(memory_displacement_gain=10.0, low_dimensional_gain=4.0, use_vision=False).eval()
    read = []
    policy.model.memory_head.lstm.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0]))
    batch = batch_of(policy)
    policy.predict_run(batch, n_steps=1)
    n = policy.config.memory_steps
    state = batch["observation.state"][:, -n:]
    displacement = read[0][..., policy.config.embedding_size :]
    torch.testing.assert_close(displacement, 10 * (state - state[:, -1:]), atol=1e-4, rtol=1e-4)


def test_a_reader_reads_the_displacement_of_the_frame_that_it_chooses():
    policy = make_policy(memory_displacement_gain=10.0, low_dimensional_gain=4.0, memory_readers=1).eval()
    head, n_fused, n = policy.model.memory_head, policy.config.embedding_size, policy.config.memory_steps
    frames = torch.randn(2, n + 1, head.lstm.input_size)
    frames[..., 0], frames[0, 2, 0], frames[1, 1, 0] = 0.0, 1.0, 1.0  # the frames with a touch
    lstm_alone = head.recall(frames)  # a new reader reads nothing
    with torch.no_grad():
        head.recollection.score.weight.zero_()[0, 0] = 30.0
        torch.nn.init.eye_(head.recollection.read.weight)
    read = head.recall(frames) - lstm_alone  # (2, 2, D)
    felt = 2.5 * frames[..., n_fused:]
    touched = torch.stack([felt[0, 2], felt[1, 1]])
    for window in range(2):
        torch.testing.assert_close(
            read[:, window, : felt.shape[2]], touched - felt[:, n - 1 + window], atol=1e-3, rtol=1e-4
        )


@pytest.mark.parametrize("n_readers", [0, 2])
def test_where_nothing_is_felt_there_is_nothing_to_compare(n_readers):
    config = make_config(**SMALL, memory_displacement_gain=10.0, memory_readers=n_readers)
    for key in config.low_dimensional_keys:
        del config.input_features[key]
    policy = PlaybyearPolicy(config).eval()
    assert policy.model.memory_head.lstm.input_size == config.embedding_size
    episode = make_episode(3, config, N_FRAMES)
    last = policy.predict_run(run_ending_at(episode, N_FRAMES - 1, config))[:, -1]
    torch.testing.assert_close(step_through(policy, [episode])[:, -1], last, atol=1e-5, rtol=0)


# Heads


@pytest.mark.parametrize("kind", HEADS)
def test_a_head_changes_the_loss_by_its_weight_and_its_gradient_reaches_the_senses(kind):
    policy = make_policy(**CANDIDATES[kind], use_vision=False)
    batch = batch_of(policy)
    loss, figures = policy.forward(batch)
    factor = CANDIDATES[kind][f"auxiliary_{kind}"]
    torch.testing.assert_close(loss, figures["loss_action"] + factor * figures[f"loss_{kind}"])
    network = policy.model
    encodings = network.encode_run(batch, policy.config.n_run_frames)
    outputs = network.memory_head.recall(encodings)
    ((error, _),) = losses_of(policy, batch, encodings[:, -outputs.shape[1] :], outputs)
    policy.zero_grad()
    error.sum().backward()
    ear = next(iter(network.hearing.parameters())).grad
    assert ear is not None
    assert ear.abs().max() > 0
    assert all(parameter.grad is None for parameter in network.memory_head.head.parameters())


def test_heads_are_used_neither_for_a_held_out_loss_nor_to_act():
    policy = make_policy(**EVERYTHING).eval()
    plain = make_policy(**{name: value for name, value in EVERYTHING.items() if "auxiliary" not in name}).eval()
    plain.model.load_state_dict({k: v for k, v in policy.model.state_dict().items() if "auxiliary" not in k})
    for module in policy.modules():
        if isinstance(module, AuxiliaryHeads):
            module.register_forward_pre_hook(lambda *_: pytest.fail("a head was asked"))
    with torch.no_grad():
        loss, figures = policy.forward(batch_of(policy))
        assert figures == {}
        assert torch.equal(loss, plain.forward(batch_of(plain))[0])
        step_through(policy, [make_episode(3, policy.config, 3)])


def test_the_network_begins_as_without_heads():
    policies = [PlaybyearPolicy((torch.manual_seed(4), make_config(**(SMALL | options)))[1]) for options in
                ({}, {f"auxiliary_{kind}": 1.0 for kind in HEADS})]  # fmt: skip
    plain, with_heads = (policy.model.state_dict() for policy in policies)
    assert all(torch.equal(with_heads[name], value) for name, value in plain.items())
    assert len(with_heads) > len(plain)


def test_sample_weights_get_every_part_of_the_loss_per_item():
    policy = make_policy(**{f"auxiliary_{kind}": 0.5 for kind in HEADS}, use_vision=False)
    policy.keep_normalization()
    one, other = batch_of(policy, 1), batch_of(policy, 2, last=3)
    both = {key: torch.cat([one[key], other[key]]) for key in one}
    losses, _ = policy.forward(both, reduction="none")
    for loss, batch in zip(losses, (one, other), strict=True):
        torch.testing.assert_close(policy.forward(batch)[0], loss, rtol=1e-4, atol=1e-5)


def clicks(policy, frames, seed=1):
    """An episode of faint noise with a click in some frames."""
    episode = make_episode(seed, policy.config, N_FRAMES)
    generator = torch.Generator().manual_seed(seed)
    sound = 30 * torch.randn(N_FRAMES, 800, generator=generator)
    for frame in frames:
        sound[frame, 300:340] += 8000
    episode[MICROPHONE] = sound.to(torch.int16)
    return episode


def levels_of(batch):
    return torch.log10((batch[MICROPHONE] / 32768).square().mean(dim=2) + 1e-10).unsqueeze(2)


def onsets_of(batch):
    """Of the last five frames."""
    return onsets(levels_of(batch), 5).tolist()


def ways_of(policy, batch):
    return ways_from_onsets(levels_of(batch), batch["observation.state"][:, -policy.config.n_run_frames :], 3)


def test_an_onset_is_a_click_and_not_what_rings_on_nor_steady_noise():
    policy = make_policy(auxiliary_onset=1.0)
    batch = run_ending_at(clicks(policy, (12, 13, 15)), N_FRAMES - 1, policy.config)
    assert onsets_of(batch) == [[0, 1, 0, 0, 1]]  # frames 11 to 15
    louder = {**batch, MICROPHONE: run_ending_at(clicks(policy, ()), 15, policy.config)[MICROPHONE] * 40}
    assert onsets_of(louder) == [[0] * 5]


def test_what_swells_is_no_onset():
    """It crosses the threshold all the same: each frame is 7 dB louder than the one before."""
    policy = make_policy(auxiliary_onset=1.0)
    episode = clicks(policy, ())
    for k, frame in enumerate(range(12, 16), start=1):
        episode[MICROPHONE][frame] = (episode[MICROPHONE][frame] * 2.2**k).to(torch.int16)
    batch = run_ending_at(episode, 15, policy.config)
    assert onsets_of(batch) == [[0, 0, 0, 0, 0]]
    episode[MICROPHONE][14] = episode[MICROPHONE][11]  # what comes after a pause is one
    assert onsets_of(run_ending_at(episode, 15, policy.config)) == [[0, 0, 0, 0, 1]]


def test_the_way_is_from_the_last_onset_that_the_memory_holds():
    policy = make_policy(auxiliary_way=1.0)  # three frames of memory
    episode = clicks(policy, (11, 14))
    episode["observation.state"] = torch.arange(N_FRAMES * 1.0).square().unsqueeze(1) * torch.full((7,), 0.03)
    batch = run_ending_at(episode, 15, policy.config)
    ways, is_known = ways_of(policy, batch)
    assert is_known.tolist() == [[1, 1, 1, 1, 1]]
    assert ways[0, :, 0].tolist() == pytest.approx([0, -0.69, -1, 0, -0.87], abs=1e-5)  # frames 11 to 15; -1.44 is far
    quiet = batch | {MICROPHONE: run_ending_at(clicks(policy, (11,)), 15, policy.config)[MICROPHONE]}
    assert ways_of(policy, quiet)[1].tolist() == [[1, 1, 1, 0, 0]]


def test_an_envelope_keeps_how_loud_it_was():
    """Brought to the same size, the encodings of a faint and of a loud click are nearly the same."""
    policy = make_policy(audio_envelope_gain=0.3).eval()
    n = policy.config.n_segments
    heard = []
    for factor in (1, 4):
        episode = clicks(policy, ())
        episode[MICROPHONE][15, 300:340] += 2000 * factor
        heard.append(policy.model._hear(run_ending_at(episode, 15, policy.config), MICROPHONE, 2))
    faint, loud = (one.detach() for one in heard)
    assert faint.shape == (2, policy.model.hearing["audio_gripper"].embedding_size + n)
    louder = (loud - faint)[:, -n:] / 0.3
    assert louder[0].abs().max() < 1e-4  # the frame before
    assert louder[1, :-3].abs().max() < 1e-4
    spread = policy.model.spectrogram["audio_gripper"].variance.sqrt()
    assert float(louder[1, -1]) == pytest.approx(float((1.2 / spread).mean()), rel=0.1)  # 12 dB, in deviations of a bin
    step_by_step = step_through(policy, [clicks(policy, (12,))])
    at_once = policy.predict_run(run_ending_at(clicks(policy, (12,)), 15, policy.config))
    torch.testing.assert_close(step_by_step[:, -1], at_once[:, -1], atol=1e-5, rtol=0)


LEFT, RIGHT = (f"observation.audio.{side}" for side in ("left", "right"))


def two_ears(**options):
    torch.manual_seed(0)
    return PlaybyearPolicy(make_config(microphones=("left", "right"), use_vision=False, **(SMALL | options))).train()


def clicks_of_two(policy, clicked):
    """An episode of faint noise with a click in some frames, a tenth as loud at the other microphone: {frame: microphone}."""
    episode = make_episode(1, policy.config, N_FRAMES)
    generator = torch.Generator().manual_seed(1)
    for key in (LEFT, RIGHT):
        sound = 30 * torch.randn(N_FRAMES, 800, generator=generator)
        for frame, loudest in clicked.items():
            sound[frame, 300:340] += 8000 if key == loudest else 800
        episode[key] = sound.to(torch.int16)
    return run_ending_at(episode, N_FRAMES - 1, policy.config)


def test_the_balance_is_who_hears_an_onset_louder():
    policy = two_ears(auxiliary_balance=1.0)
    batch = clicks_of_two(policy, {12: LEFT, 15: RIGHT})
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


def test_the_balance_is_learned_from_the_ears_and_needs_two_of_them():
    policy = two_ears(auxiliary_balance=1.0)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    batches = [clicks_of_two(policy, {frame: side}) for frame in (11, 13, 15) for side in (LEFT, RIGHT)]
    batch = {key: torch.cat([one[key] for one in batches]) for key in batches[0]}
    losses = []
    for _ in range(110):
        loss, figures = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(figures["loss_balance"]))
    assert losses[-1] < 0.1 * losses[0]
    assert make_policy(auxiliary_balance=1.0).model.auxiliary is None
    assert two_ears(auxiliary_balance=1.0, use_audio=False).model.auxiliary is None


# Refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"auxiliary_onset": -1.0}, r"auxiliary_onset must be at least 0 \(none\) and finite, got -1.0"),
        ({"auxiliary_way": math.inf}, r"auxiliary_way must be at least 0"),
        ({"low_dimensional_offset": -0.1}, r"low_dimensional_offset must be at least 0 \(none\) and finite, got -0.1"),
        ({"memory_displacement_gain": 10.0, "low_dimensional_gain": 0.0}, r"low_dimensional_gain is 0: give 4"),
        ({"memory_readers": -1}, r"memory_readers must be at least 0 \(none\) and finite, got -1"),
        ({"memory_readers": 2}, r"memory_readers=2 read displacements, .*memory_displacement_gain is 0: give 10"),
    ],
)
def test_what_cannot_be_is_refused_with_the_option(options, message):
    with pytest.raises(ValueError, match=rf"--policy\.{message}"):
        make_config(**options)


def test_a_deaf_policy_learns_as_if_nobody_had_asked_for_what_needs_sound():
    deaf, asked = make_policy(use_audio=False), make_policy(use_audio=False, auxiliary_onset=0.3, auxiliary_way=0.3)
    assert asked.model.auxiliary is None
    torch.testing.assert_close(asked.state_dict(), deaf.state_dict(), rtol=0, atol=0)
