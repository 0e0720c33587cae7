"""Other packages add an encoder, a step for microphones, an expert and a source of sound by name: the examples, installed."""

import json
import shutil
import sys

import draccus
import gymnasium as gym
import numpy as np
import pytest
import torch
from draccus.utils import DecodingError
from lerobot.processor import ProcessorStepRegistry
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file
from support.distributions import install_example, longest_file
from support.policy import MICROPHONE, make_config, make_episode, make_policy, run_ending_at, step_through
from support.shared import ENV, TINY, n_evaluated, run_in_process
from torch import nn

from lerobot_playbyear.audio.microphone_pictures import read_strip
from lerobot_playbyear.dagger import ExpertConfig
from lerobot_playbyear.microphones import MicrophoneCamera, MicrophoneCameraConfig, MicrophoneError
from lerobot_playbyear.policy.extension import SoundStep, register_vision_encoder
from lerobot_playbyear.policy.processor_playbyear import make_playbyear_pre_post_processors
from lerobot_playbyear.scripts.commands import train

THEIRS = {"audio_encoder": "spectrogram_gru", "audio_steps": ("remove_offset",)}


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    site = tmp_path_factory.mktemp("extension") / "site"
    for example in ("extension", "own_microphone"):
        install_example(example, site)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        register_third_party_plugins()
        yield


@pytest.mark.parametrize("example", ["extension", "own_microphone", "own_task"])
def test_the_examples_are_short(example):
    assert longest_file(example) < 100


@pytest.mark.parametrize(
    "command",
    [train, pytest.param(lerobot_train.main, marks=pytest.mark.slow)],
    ids=["playbyear-train", "lerobot-train"],
)
def test_a_policy_with_their_encoder_and_their_step_trains_and_acts(command, noise, tmp_path):
    options = "{waveform_cnn: {channels: 4}, remove_offset: {share: 0.5}}"
    own = (
        "--policy.audio_encoder=waveform_cnn",
        "--policy.audio_steps=[remove_offset]",
        f"--policy.extension_options={options}",
    )
    own += ("--preset=cpu",) if command is train else ()  # as the page has it
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={noise}")
    run_in_process(command, *TINY, *own, *data, "--steps=2", f"--output_dir={tmp_path / 'train'}")
    checkpoint = tmp_path / "train/checkpoints/last/pretrained_model"
    saved = json.loads((checkpoint / "config.json").read_text())
    assert (saved["audio_encoder"], saved["vision_encoder"]) == ("waveform_cnn", "resnet18")
    steps = json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]
    assert [step["registry_name"] for step in steps][-2:] == ["remove_offset", "normalizer_processor"]
    assert steps[-2]["config"] == {"share": 0.5}
    assert load_file(checkpoint / "model.safetensors")["model.hearing.audio_gripper.layers.0.weight"].shape == (
        4,
        1,
        80,
    )
    assert n_evaluated(checkpoint, tmp_path / "eval", *ENV, "--env.episode_length=5") == 1
    if command is train:
        _trained_on_with_other_options(checkpoint, data, tmp_path)


def _trained_on_with_other_options(checkpoint, data, tmp_path):
    """What the configuration says is what the step does."""
    on = (f"--policy.path={checkpoint}", "--policy.push_to_hub=false", *data, "--num_workers=0", "--batch_size=2")
    options = '--policy.extension_options={"waveform_cnn": {"channels": 4}, "remove_offset": {"share": 0.25}}'
    run_in_process(train, *on, options, "--steps=1", f"--output_dir={tmp_path / 'on'}")
    saved = tmp_path / "on/checkpoints/last/pretrained_model"
    assert json.loads((saved / "config.json").read_text())["extension_options"]["remove_offset"] == {"share": 0.25}
    steps = json.loads((saved / "policy_preprocessor.json").read_text())["steps"]
    assert steps[-2]["config"] == {"share": 0.25}


@torch.no_grad()
@pytest.mark.parametrize(
    "options",
    [
        {"audio_encoder": "spectrogram_gru"},
        {"audio_encoder": "waveform_cnn"},
        {"audio_encoder": "waveform_cnn", "audio_envelope_gain": 1.0},
    ],
    ids=str,
)
def test_an_encoder_of_windows_hears_the_same_in_training_and_in_a_rollout(options):
    policy = make_policy(**options)
    episode = make_episode(seed=1, config=policy.config)
    stepped = step_through(policy, [episode])
    whole = policy.act_from(policy.memory_run(run_ending_at(episode, 54, policy.config, 55), 55))
    torch.testing.assert_close(stepped, whole, atol=1e-5, rtol=0)


@ProcessorStepRegistry.register("tests_halve_the_state")
class HalveTheState(SoundStep):
    def observation(self, observation):
        return {**observation, OBS_STATE: observation[OBS_STATE] / 2}


@pytest.mark.parametrize(
    "step",
    [
        {"registry_name": "tests_halve_the_state", "config": {}},
        {
            "registry_name": "rename_observations_processor",
            "config": {"rename_map": {"observation.no": "observation.nothing"}},
        },
    ],
    ids=lambda step: step["registry_name"],
)
def test_a_policy_whose_preprocessor_has_another_registered_step_trains_on(step, trained, recorded, tmp_path):
    """Wherever actions alone are normalised, steps that want an observation are left out."""
    checkpoint = shutil.copytree(trained, tmp_path / "policy")
    file = checkpoint / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    content["steps"].insert(2, step)
    file.write_text(json.dumps(content))
    data = ("--dataset.repo_id=tests/demos", f"--dataset.root={recorded}", "--num_workers=0", "--batch_size=2")
    output = f"--output_dir={tmp_path / 'out'}"
    assert (
        run_in_process(train, f"--policy.path={checkpoint}", "--policy.push_to_hub=false", *data, "--steps=1", output)
        is None
    )
    saved = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/policy_preprocessor.json").read_text())
    assert step["registry_name"] in [each["registry_name"] for each in saved["steps"]]


def test_a_step_gets_runs_in_training_and_frames_in_a_rollout_and_nothing_but_sound():
    preprocess, _ = make_playbyear_pre_post_processors(make_config(**THEIRS))
    sound = torch.randint(900, 1100, (2, 5, 800), dtype=torch.int16)
    others = {f"{MICROPHONE}_is_pad": torch.ones(2, 5, dtype=torch.bool), "observation.state": torch.ones(2, 5, 7)}
    run = preprocess({MICROPHONE: sound, **others})
    assert run[MICROPHONE].mean(dim=-1).abs().max() < 1e-6
    assert all(torch.equal(run[key], value) for key, value in others.items())
    frame = preprocess({MICROPHONE: sound[:, 3] / 32768})
    torch.testing.assert_close(frame[MICROPHONE], run[MICROPHONE][:, 3])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"waveform_cnn": {"width": 4}}, r"unexpected keyword argument 'width'. Its options: channels"),
        (
            {"spectrogram_gru": {}},
            r"extension_options names spectrogram_gru; .* there are resnet18, waveform_cnn, remove_offset",
        ),
    ],
)
def test_an_option_that_theirs_lack_is_refused_by_name(options, said):
    with pytest.raises((ValueError, DecodingError), match=said):
        make_policy(audio_encoder="waveform_cnn", audio_steps=("remove_offset",), extension_options=options)


def test_a_steps_option_is_refused_by_name():
    config = make_config(audio_steps=("remove_offset",), extension_options={"remove_offset": {"channels": 4}})
    with pytest.raises(ValueError, match=r"unexpected keyword argument 'channels'. Its options: share"):
        make_playbyear_pre_post_processors(config)


def test_lerobots_command_says_last_what_the_policy_refuses(commands):
    for option in ("dtype=half", "action_range=0", "extension_options={nobody: {a: 1}}"):
        result = commands.run(
            "lerobot-train", "--policy.type=playbyear", f"--policy.{option}", "--dataset.repo_id=me/none"
        )
        assert f"--policy.{option.partition('=')[0]}" in result.output.strip().splitlines()[-1]


def test_their_expert_takes_over_when_it_is_loud():
    expert_config = draccus.decode(ExpertConfig, {"type": "startled", "loud": 0.2, "steps": 2})
    env = gym.make("gym_playbyear:gym_playbyear/OccludedGrasp-v1")
    observation, _ = env.reset(seed=0)
    expert = expert_config.make(env)
    expert.reset(env)
    loud = {**observation, "audio.gripper": np.full(800, -9000, np.int16)}
    wants = [expert.wants_control(heard, np.zeros(4)) for heard in (observation, loud, observation, observation)]
    assert wants == [False, True, True, False]
    assert env.action_space.contains(expert.act())


_SEVENS = """import sys, time
began, written = time.monotonic(), 0
while True:  # as much as a sound card's clock would have brought by now
    due = int((time.monotonic() - began) * {sample_rate})
    sys.stdout.buffer.write(bytes([7, 0]) * {channels} * (due - written)); sys.stdout.flush()
    written = due
    time.sleep(0.01)"""


def test_their_microphone_is_heard_and_says_what_it_cannot_start(tmp_path):
    """A program, which a process of its own runs, prints nothing but samples of 7."""
    (tmp_path / "sevens.py").write_text(_SEVENS.replace("{channels}", "2").replace("{sample_rate}", "16000"))
    options = {"sample_rate": 16000, "save_to": "none", "source": "program"}
    camera = MicrophoneCamera(
        MicrophoneCameraConfig(**options, device=f"{sys.executable} {tmp_path / 'sevens.py'}", channel=1)
    )
    camera.connect()
    try:
        samples = read_strip(camera.read_latest()).samples
        assert np.median(samples) == 7
        assert set(np.unique(samples)) <= {0, 7}  # 0: what a busy machine lost
    finally:
        camera.disconnect()
    with pytest.raises(MicrophoneError, match=r"'no_such_program' does not start: .*Give `device` a command"):
        MicrophoneCamera(MicrophoneCameraConfig(**options, device="no_such_program")).connect()


def test_a_vision_encoder_of_another_package_learns_and_acts():
    @register_vision_encoder("test_colours")
    class Colours(nn.Module):
        embedding_size = 9

        def __init__(self, config):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(3 * config.frame_stack, 1, 1))

        def forward(self, stacks):
            return (self.weight * stacks).mean(dim=(2, 3))

    policy = make_policy(vision_encoder="test_colours")
    assert [name for name, _ in policy.named_parameters() if "vision" in name] == ["model.vision.images_front.weight"]
    episode = make_episode(1, policy.config, 3)
    assert step_through(policy, [episode]).shape == (1, 3, 4)
    with pytest.raises(ValueError, match="'test_colours' is registered already, by test_extension"):
        register_vision_encoder("test_colours")(Colours)
