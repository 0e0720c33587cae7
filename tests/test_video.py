"""Films: pictures and sound in time with each other, in a file that players take."""

from contextlib import nullcontext
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import ACTConfig, make_policy, make_policy_config, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.policy_actor import load_policy_actor
from lerobot_playbyear.film.rollout_film import VideoConfig, film
from lerobot_playbyear.film.video import compose, film_sound, write_film

FPS, SAMPLE_RATE = 20, 16000
BLOCK = SAMPLE_RATE // FPS


def decode(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """All pictures (n, H, W, 3) and all sound (n_channels, n) of a film."""
    with av.open(str(path)) as container:
        pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
    with av.open(str(path)) as container:
        sound = [block.to_ndarray() for block in container.decode(audio=0)]
    return np.stack(pictures), np.concatenate(sound, axis=1)


def small_env(**options) -> PlaybyearEnvConfig:
    return PlaybyearEnvConfig(image_size=16, visualization_width=128, visualization_height=128, **options)


def test_an_experts_film_has_every_step_and_its_sound(tmp_path, capsys):
    path = film(VideoConfig(small_env(), output=tmp_path / "film.mp4", seed=0))
    pictures, sound = decode(path)
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.audio[0].codec_context.name == "aac"
        assert container.streams.video[0].average_rate == FPS
    assert pictures.shape[1:] == (248, 128, 3)  # picture and strip
    assert sound.shape[1] / SAMPLE_RATE == pytest.approx(len(pictures) / FPS, abs=0.2)
    assert np.abs(sound).max() > 0.5
    assert "success" in capsys.readouterr().out


def test_a_click_is_heard_when_it_is_seen(tmp_path):
    """The block of frame t was heard before picture t: a click at its end belongs to picture t."""
    blocks = np.zeros((40, BLOCK), np.int16)
    blocks[20, -10:] = 20000
    pictures = [np.zeros((32, 32, 3), np.uint8)] * 40
    sound, _ = film_sound([blocks.reshape(-1)], 40, FPS)
    assert sound.shape == (40 * BLOCK, 1)
    path = write_film(tmp_path / "click.mp4", compose(pictures, 40, sound, SAMPLE_RATE), FPS, sound, SAMPLE_RATE)
    _, heard = decode(path)
    assert np.abs(heard[0]).argmax() / SAMPLE_RATE == pytest.approx(20 / FPS, abs=0.01)


def test_two_microphones_are_left_and_right(tmp_path):
    sound = np.zeros((40 * BLOCK, 2), np.int16)
    sound[:, 1] = (10000 * np.sin(2 * np.pi * 440 / SAMPLE_RATE * np.arange(len(sound)))).astype(np.int16)
    pictures = [np.zeros((32, 32, 3), np.uint8)] * 40
    _, heard = decode(write_film(tmp_path / "stereo.mp4", pictures, FPS, sound, SAMPLE_RATE))
    left, right = np.abs(heard).mean(axis=1)
    assert right > 0.1
    assert left < 0.01


def test_a_film_without_microphones_is_silent(tmp_path):
    """Here of a script that does not hear."""
    env = small_env(sound="none", episode_length=5)
    path = film(VideoConfig(env, output=tmp_path / "film.mp4", baseline="search"))
    with av.open(str(path)) as container:
        assert not container.streams.audio
        assert container.streams.video[0].frames == 6


def save_act(env: PlaybyearEnvConfig, folder: Path, **options) -> ACTConfig:
    """A small policy of LeRobot's own, untrained."""
    features = env_to_policy_features(env)
    small = {"pretrained_backbone_weights": None, "dim_model": 32, "n_heads": 2, "dim_feedforward": 32}
    inputs = {key: features[key] for key in ("observation.state", "observation.images.front")}
    kinds = {"input_features": inputs, "output_features": {"action": features["action"]}}
    config = make_policy_config("act", device="cpu", push_to_hub=False, **small, **kinds, **options)
    make_policy(config, env_cfg=env).save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats={}):
        processor.save_pretrained(folder)
    config.pretrained_path = folder
    return config


@pytest.mark.slow
@pytest.mark.parametrize("use_amp", [False, True])
def test_any_lerobot_policy_acts_bit_for_bit_as_in_lerobot_eval_and_is_filmed(tmp_path, use_amp):
    env_cfg = small_env(episode_length=4)
    policy_cfg = save_act(env_cfg, tmp_path, use_amp=use_amp, n_action_steps=1)
    pictures, _ = decode(film(VideoConfig(env_cfg, policy=policy_cfg, output=tmp_path / "film.mp4", attempts=2)))
    assert len(pictures) == 5
    env = env_spec(env_cfg).make()
    episode = play(env, load_policy_actor(policy_cfg, env_cfg), seed=5)
    env.close()

    policy = make_policy(policy_cfg, env_cfg=env_cfg).eval()
    from_env, _ = make_env_pre_post_processors(env_cfg, policy_cfg)

    def to_env(transition):  # LeRobot makes NumPy's arrays of actions, which know no bfloat16
        return {"action": transition["action"].float()}

    processors = (from_env, to_env, *make_pre_post_processors(policy_cfg, str(tmp_path)))
    vec = make_env(env_cfg)["playbyear"][0]
    with torch.no_grad(), torch.autocast("cpu") if use_amp else nullcontext():
        result = rollout(vec, policy, *processors, seeds=[5])
    vec.close()
    np.testing.assert_array_equal(episode.actions, result["action"][0].clamp(-1, 1))
    assert episode.actions.any()


def test_an_interrupted_film_leaves_no_file(tmp_path):
    def pictures():
        yield np.zeros((32, 32, 3), np.uint8)
        raise RuntimeError("the camera broke")

    with pytest.raises(RuntimeError, match="camera broke"):
        write_film(tmp_path / "film.mp4", pictures(), FPS, np.zeros((BLOCK, 1), np.int16), SAMPLE_RATE)
    assert not list(tmp_path.iterdir())
