"""What is refused: in one line, before any work, with the option, its value and what would work.

A row is a command that works, changed by some options (`-name` takes one away, `NAME=value` is of the environment), and what
its message says, between bars. What stands in braces is made when the first row names it. A command that refuses leaves nothing
in `{out}`. The second table is of what is refused to whoever calls the package: a function below, its arguments, and the same.
"""

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from dataset_factory import MICROPHONE, dataset_features, make_dataset, rollout_dataset
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from support.shared import ENV, TINY
from test_attach_audio import write_sounds

from gym_playbyear.check.report import check
from gym_playbyear.environment import TaskEnv
from lerobot_playbyear.audio import write_audio
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

BASE = {
    "record": f"playbyear-record {' '.join(ENV)} --dataset.repo_id=t/new --dataset.root={{out}}/new --num_workers=0",
    "train": f"playbyear-train {' '.join(TINY)} --dataset.repo_id=t/noise --dataset.root={{noise}} --steps=1 "
    "--output_dir={out}/train",
    "train nothing": "playbyear-train --dataset.repo_id=t/noise --dataset.root={noise} --output_dir={out}/train",
    "train act": "playbyear-train --policy.type=act --policy.push_to_hub=false --dataset.repo_id=t/noise "
    "--dataset.root={noise} --output_dir={out}/train",
    "dagger": f"playbyear-dagger {' '.join(ENV)} --policy.path={{policy}} --dataset.repo_id=tests/demos "
    "--dataset.root={demos} --interventions.repo_id=t/corrections --interventions.root={out}/corrections --eval_every=0 "
    "--batch_size=4 --warmup_episodes=1 --updates_per_episode=2 --output_dir={out}/dagger",
    "learn": "playbyear-dagger --policy.path={policy} --dataset.repo_id=tests/demos --dataset.root={demos} "
    "--interventions.repo_id=t/corrections --interventions.root={demos} --num_episodes=0 --steps=2 --batch_size=4 "
    "--output_dir={out}/dagger",
    "attach-audio": "playbyear-attach-audio --dataset.repo_id=t/silent --dataset.root={silent} --output.repo_id=t/heard "
    "--output.root={out}/heard --files={sounds}/{{episode:03d}}.wav --microphone=gripper --offset=0.25",
    "session": "playbyear-attach-audio --dataset.repo_id=t/silent --dataset.root={silent} --output.repo_id=t/heard "
    "--output.root={out}/heard --session={sounds}/day.wav --clock={sounds}/starts.csv --microphone=gripper",
    "attach-spectrogram": "playbyear-attach-spectrogram --dataset.repo_id=t/noise --dataset.root={noise} "
    "--output.repo_id=t/seen --output.root={out}/seen --seconds=0.5",
    "inspect": "playbyear-inspect --dataset.repo_id=t/noise --dataset.root={noise}",
    "repair": "playbyear-repair --root={noise}",
    "push": "playbyear-push --dataset.repo_id=me/set --dataset.root={noise}",
    "push policy": "playbyear-push --policy.path={policy} --policy.repo_id=me/policy",
    "video": f"playbyear-video {' '.join(ENV)} --output={{out}}/film.mp4",
    "find-microphones": "playbyear-find-microphones",
}

COMMANDS = """
# Told from the command line alone
dagger | --strategy.num_episodes=3 | --strategy.num_episodes is not an option; did you mean --num_episodes?
dagger | --dataset.num_episodes=3 | did you mean --num_episodes?
train | --bach_size=3 | --bach_size is not an option; did you mean --batch_size?
train | --policy.image_sise=3 | did you mean --policy.image_size?
train | --steps=many | steps | 'many' into an int
train | --steps | --steps needs a value
train | cpu | 'cpu' is not an option
train | -dataset.repo_id | --dataset.repo_id is needed
record | --robot.type=so101_follower | lerobot-record --robot.type=so101_follower | type: microphone | playbyear-attach-audio
record | --robot.port=/dev/ttyUSB7 --robot.type=koch_follower | --robot.type=koch_follower --robot.port=/dev/ttyUSB7
record | '--robot.cameras={{a: {{type: opencv}}}}' | {a: {type: opencv}, gripper: {type: microphone
dagger | --teleop.type=so100_leader | lerobot-rollout --strategy.type=dagger | --teleop.type=so100_leader | --expert.teleop.type
video | --robot.type=so101_follower | lerobot-rollout --robot.type=so101_follower
# Places
record | --dataset.root={noise} | {noise} already holds a dataset | --resume=true
record | --dataset.root={full} --resume=true | There is no LeRobotDataset in '{full}': | it holds thesis.tex
record | --dataset.root={file}/new | Cannot write | {file}
record | --dataset.root={truncated} --resume=true | {truncated} | damaged | playbyear-repair --root={truncated}
record | --dataset.root={noise} --resume=true | {noise} does not fit | seed is absent there | choose another root
train | --output_dir={full} | {full} already exists | resume
train | --output_dir={file}/run | --output_dir={file}/run cannot be written: Not a directory | wanted
train | --dataset.root={dangling} | There is no LeRobotDataset in '{dangling}': it has no meta/info.json | Correct
train | --dataset.root={nowhere} | {nowhere}/meta/info.json is damaged: data_path is None | --like=
train | --dataset.root={truncated} | file-000.parquet is truncated | playbyear-repair --root={truncated}
dagger | --output_dir={full} | {full} holds files, but no run of playbyear-dagger
dagger | --interventions.root={demos} | --dataset and --interventions are the same dataset | of their own
dagger | --interventions.root={out}/dagger | --output_dir={out}/dagger lies in the folder of --interventions
attach-audio | --output.root={noise} | {noise} | is there already
attach-audio | --dataset.root={out}/no | There is no LeRobotDataset in '{out}/no': it does not exist
inspect | --dataset.root={out}/no | There is no LeRobotDataset in '{out}/no': it does not exist | Correct
inspect | --html={file}/page.html | The page cannot be written | {file}
repair | --like={full} | --like={full} holds no LeRobotDataset | the same settings
push policy | --policy.path={noise} | there is no checkpoint with config.json | {noise}
video | --output={out}/film | --output={out}/film: films are mp4 | ends with .mp4
video | --output={folder_mp4} | --output={folder_mp4}: that is a folder; give the name of a file
video | --output={file}/film.mp4 | {file}/film.mp4 cannot be written: Not a directory
# Names on the Hub
record | --dataset.push_to_hub=true --dataset.repo_id=t/no+name | repo_id='t/no+name'
train | --policy.push_to_hub=true | 'repo_id' argument missing
train | --policy.push_to_hub=true --policy.repo_id=me/no+name | policy.repo_id='me/no+name' cannot be pushed
dagger | --policy.push_to_hub=true | --policy.push_to_hub=true needs a name: give --policy.repo_id
dagger | --policy.push_to_hub=true --policy.repo_id=me/no+name | repo_id='me/no+name' cannot be pushed
push | -dataset.repo_id -dataset.root | Give either --dataset.repo_id
push | --policy.path={policy} | Give either --dataset.repo_id
push | -dataset.repo_id | needs --dataset.repo_id, the dataset's name on the Hub
push | --dataset.repo_id=nameless | 'nameless' | give it as user/name
push | --dataset.repo_id=me/no+name | dataset.repo_id='me/no+name' cannot be pushed: Repo id
push | --preview={noise}/meta/info.json | {noise}/meta/info.json | cards show mp4
push policy | -policy.repo_id | needs --policy.repo_id, the policy's name on the Hub
# Environments
record | --env.task=Nope-v1 | `env.task`: 'Nope-v1' | OccludedGrasp-v1 | KeyBag-Hard-v1
record | --env.sample_rate=16001 | `env.sample_rate`: 16001 | a multiple of 20
record | --env.fps=30 | `env.fps`: 30 | give 20, or leave it out
record | --env.microphones=[] | env.microphones | at least one
record | --env.visualization_width=100 | `env.visualization_width`: 100 | square
record | --env.room_noise_level=8 | `env.room_noise_level`: 8.0 | name a WAV file with --env.room_noise
record | --env.sound=none --env.microphone_response=phone | env.microphone_response | no sound
record | --env.attempts_file={full} | attempts_file | {full} | it is a folder, give a file
record | '--env.task_options={{colour: blue}}' | {'colour': 'blue'} | OccludedGrasp-v1 has no such option
record | --env.spectrogram={noise} | {noise} | names no pictures of sound
# Recording
record | --dataset.num_episodes=0 | --dataset.num_episodes=0: give at least 1
record | --dataset.fps=30 | --dataset.fps=30, but the environment runs at 20 | leave it out
record | --seed=-1 | --seed=-1: give 0 or more
record | --dataset.rgb_encoder.vcodec=h264 | --dataset.rgb_encoder | give --dataset.video=true
record | --expert.type=test | --expert.type | test | scripted
record | --expert.type=teleop --expert.speed=0 | speed=0
record | --expert.type=teleop --expert.takeover_key=f1 | takeover_key='f1' | a letter, a digit
record | --expert.type=teleop --expert.takeover_key=e | takeover_key='e': it means something else
record | --expert.type=teleop --expert.takeover=press | takeover='press' | give hold or toggle
record | --expert.type=teleop | No window can be opened (DISPLAY='')
# Training
train nothing | --reward_model.path={reward} | No policy: give --preset=cpu
train act | --steps=1 | --policy.type=act | --policy.type=playbyear | lerobot-train
train | --preset=paper --policy.type=act | --preset=paper is for --policy.type=playbyear, not for act
train | --store=tape | --store=tape is not known: wanted one of memory, disk, auto
train | --dataset.streaming=true | --dataset.streaming does not work | --store=disk
train | --dataset.image_transforms.enable=true | --dataset.image_transforms.enable does not work | lerobot-train
train | --policy.fps=20 --dataset.root={slow} | 10 frames per second | configured for 20 | --policy.fps=10
train | --dataset.root={deaf} | observation.audio | --policy.use_audio=false
train | --policy.sample_rate=48001 | sample_rate / fps = 48001 / 20
train | --policy.path={policy} -policy.type --policy.fps=0 | --policy.fps must be above 0 and at most 1000, got 0
train | --policy.audio_window_s=0.5 | audio_window_s | too few for 4 convolutions
train | --policy.audio_encoder=nobody | --policy.audio_encoder=nobody | spectrogram_cnn | lerobot_policy_
train | --policy.audio_noise_db=18 --policy.audio_noise_files={out}/no | files={out}/no | no such folder
# Corrections
dagger | -env.type -env.task -env.image_size | give --env.type and --env.task, or --num_episodes=0 --steps=N
dagger | -policy.path | HG-DAgger improves a trained policy: give | --policy.path
dagger | --batch_size=5 | --batch_size=5 must be even
dagger | --steps=5 | --steps is for --num_episodes=0
dagger | --num_episodes=0 | give --steps
dagger | --eval_every=1 --eval.n_episodes=0 | --eval.n_episodes=0: give at least 1, or --eval_every=0
dagger | --new_weights=true | --new_weights=true: a policy that knows nothing cannot be corrected
dagger | --method.type=redo --skip_s=1 | --skip_s=1 | --method.type=redo the expert chooses every frame
dagger | --method.type=robot_gated --method.intervention_share=1.5 | intervention_share=1.5: give a share
dagger | --policy.action_range=2 | action_range=2.0 | trained with 1.0 | playbyear-train --preset=cpu --policy.path
dagger | --env.sample_rate=8000 | observation.audio.gripper is int16 (800,) at 16000 Hz there | --env.*
dagger | --dataset.root={48_kHz} | recorded at 48000 Hz | trained with 16000 Hz
dagger | --dataset.root={six_joints} | 'observation.state' has shape (6,) | trained with (7,)
dagger | --policy.path={act} | the type 'act' | --policy.type=playbyear | lerobot-rollout
dagger | WORLD_SIZE=2 | 2 processes were started, and playbyear-dagger works in one
dagger | --env.task=TellApart-v1 --method.type=no_handback | TellApart-v1 | no_handback needs one | --method.type=redo
dagger | --output_dir={finished}/out | {finished}/out holds a run already | --resume=true
learn | --method.type=redo --interventions.root={finished}/corrections | frames that the policy chose | another --method.type
learn | --interventions.root={untagged} | wanted 'intervention', bool (1,), and there is no such feature
learn | --interventions.root={uncorrected} | None of the 5 frames | has 'intervention' set
learn | --interventions.root={empty} | {empty} | is empty
learn | --interventions.root={six_joints} | observation.state is float32 (7,) there and float32 (6,)
# Sound that is attached
attach-audio | --files=nowhere/{{episode}}.wav | episode 0, nowhere/0.wav: There is no sound file | episode 1,
attach-audio | --files=sound.wav | --files=sound.wav | {episode}
attach-audio | --offset=3 | episode 0, | it lasts 0.850 s; 12 frames | Correct the offset
attach-audio | --microphone=left,right | 1 channels, and --microphone names 2
attach-audio | --channel=4 | there is no --channel=4
attach-audio | --offsets={out}/no.json | {out}/no.json | is not a list of numbers
attach-audio | --files={sounds}/odd/{{episode:03d}}.wav | 11025 samples per second | 20 | --sample_rate=11020
attach-audio | --dataset.root={noise} | 'observation.audio.gripper' is in the dataset already
attach-audio | --session={sounds}/day.wav | both are given. Give one
session | -session | is for --files and one --session
session | --session={out}/no.wav | --session={out}/no.wav: there is no such file or folder
session | -clock | playbyear_clock.json. Give --clock=times.csv
session | --clock={out}/tiems.csv | there is no {out}/tiems.csv. Give --clock=times.csv
session | --marks=1.0 | '1.0' is not a mark; wanted seconds in the sound file = seconds on the clock
session | --marks=1=5,2=5 | the same time on the clock
session | --marks=10=1,20=5 | 2.5000 seconds of sound in a second of the clock
attach-spectrogram | --microphones=[nose] | --microphones names 'nose'; the dataset in {noise} has gripper
attach-spectrogram | --name=front | 'observation.images.front' is in the dataset in {noise} already
attach-spectrogram | --seconds=3 | --seconds=3 | at most 0.80 | one of 16 columns | a larger --width
attach-spectrogram | --seconds=0 | --seconds=0 | above 0
attach-spectrogram | --height=5000 | height=5000; wanted at most 4096 pixels
attach-spectrogram | --low_db=10 --high_db=-10 | low_db=10.0; wanted at least -100, and below high_db=-10.0
attach-spectrogram | --dataset.root={deaf} | {deaf} has no sound in columns | playbyear-attach-audio
# Films, inspection, microphones
video | --attempts=0 | attempts=0: give at least 1
video | --baseline=deaf | no blind baseline 'deaf', only | search
video | --policy.path={policy} --baseline=search | --baseline=search: it acts without a policy
inspect | --action_range=[1,-1] | action_range=[1.0, -1.0]
find-microphones | --seconds=0 | seconds=0
"""

CALLS = """
# The policy's configuration
policy | dtype: half | --policy.dtype must be one of auto, float32, bfloat16, float16, got 'half'
policy | action_range: 0.0 | --policy.action_range must be above 0 and at most 1000, got 0
policy | audio_noise_files: here | audio_noise_files=here | how loud | --policy.audio_noise_db=24
policy | audio_room_noise: true | audio_room_noise=True | how loud | --policy.audio_noise_db=24
policy | low_dimensional_gain: .nan | --policy.low_dimensional_gain must be at least 0 (none) and finite, got nan
policy | segment_s: 0.0 | at least one segment of --policy.segment_s (0.0)
policy | audio_channels: [] | --policy.audio_channels must be one or more numbers from 1 on
policy | auxiliary_onset: -1.0 | --policy.auxiliary_onset must be at least 0 (none) and finite, got -1.0
policy | memory_displacement_gain: 10.0, low_dimensional_gain: 0.0 | --policy.low_dimensional_gain is 0: give 4
policy | memory_readers: 2 | --policy.memory_readers=2 read displacements | memory_displacement_gain is 0: give 10
# Environments
task | sound: loud | sound='loud'
task | image_size: 2 | image_size=2
task | horizon: 0 | horizon=0 | 1 or more
task | microphones: [hat] | 'hat' | name at least one of gripper
task | cube_material: jelly | cube_material='jelly' is not known
task | variant: paper | variant='paper' is not known: OccludedGrasp-v1 has no such option
task | room: {noise: no.wav} | room_noise='no.wav' | no such file
task | room: {noise_level: -1.0} | room_noise_level=-1.0
task | room: {response: vinyl} | response='vinyl' | flat, phone, dull, boomy
reset | OccludedGrasp-v1, {cube_positon: [0, 0.1]} | cube_positon= | the task's options of reset are cube_position
reset | OccludedGrasp-v1, {cube_position: [0, 0.9]} | cube_position= | on the table, nearer than 0.4 m
reset | OccludedPickPlace-v1, {bin_position: 0.1} | bin_position= | give x and y
reset | TellApart-v1, {pouch_position: [.nan, 0]} | pouch_position
reset | TellApart-v1, {contents: gravel} | contents='gravel' is not known: choose one of screws, peanuts
check | names: [tap_dance] | player='tap_dance' is not known: choose from 'expert', 'middle'
check | learned: [{name: rl, task: KeyBag-Easy-v1}] | 'rl' is not a learner's result on 'OccludedGrasp-v1'
# Features of a microphone that is recorded, of 80 samples at 1600 Hz and 20 frames per second
feature | info: {} | does not say its sample rate
feature | info: {sample_rate: 1600.5} | sample_rate 1600.5 | whole number of Hz
feature | info: {sample_rate: 1601} | a frame must hold a whole number of samples
feature | info: {sample_rate: 3200} | has shape (80,) | must be (160,)
feature | dtype: int32 | dtype 'int32'; wanted 'int16'
action | dtype: float33 | 'action' has dtype 'float33'
action | shape: [0] | 'action' has shape (0,)
# A microphone's options
microphone | file: null | nothing: give one of device, file and tone_hz
microphone | tone_hz: 440.0 | file and tone_hz: give one
microphone | sample_rate: 0 | sample_rate=0
microphone | gain_db: .nan | gain_db=nan
microphone | width: 90 | width=96
microphone | width: 225 | both even
microphone | height: 98, sample_rate: 48000 | at this width height=100
"""


def reset(task: str, options: dict) -> None:
    TaskEnv(task, sound="none").reset(seed=0, options=options)


def record(features: dict) -> None:
    DurableWriter("t/new", "never", 20, features)


SOUND = {"dtype": "int16", "shape": [80], "names": None, "info": {"sample_rate": 1600, "encoding": "pcm_s16"}}
ACTION = {"dtype": "float32", "shape": [4], "names": None}
FUNCTIONS: dict[str, Callable] = {
    "policy": PlaybyearConfig,
    "task": lambda **options: TaskEnv("OccludedGrasp-v1", **options),
    "check": lambda **options: check("OccludedGrasp-v1", 1, progress=Path("never"), **options),
    "reset": reset,
    "feature": lambda **changes: record({MICROPHONE: tuples(SOUND | changes), "action": tuples(ACTION)}),
    "action": lambda **changes: record({"action": tuples(ACTION | changes)}),
    "microphone": lambda **changes: MicrophoneCameraConfig(**{"file": "x.wav", "sample_rate": 16000, **changes}),
}


def tuples(feature: dict) -> dict:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in feature.items()}


def with_noise(**features: object) -> Callable[[Path], object]:
    """Makes a dataset of five frames of noise."""
    fps = features.get("fps", 20)
    options = dataset_features(**{"image_size": 16, **features})
    return lambda root: make_dataset(root, (5,), fps, features=options)


def without(*keys: str) -> dict[str, dict]:
    return {key: feature for key, feature in dataset_features(image_size=16).items() if key not in keys}


def truncated(root: Path) -> None:
    make_dataset(root, (5,), image_size=16)
    (path,) = (root / "data").glob("*/*.parquet")
    path.write_bytes(path.read_bytes()[:-50])


def dangling(root: Path) -> None:
    make_dataset(root, (5,), image_size=16)
    (root / "meta/info.json").unlink()
    (root / "meta/info.json").symlink_to(root / "gone.json")


def nowhere(root: Path) -> None:
    make_dataset(root, (5,), image_size=16)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({key: value for key, value in info.items() if key != "data_path"}))


def reward(folder: Path) -> None:
    folder.mkdir()
    (folder / "config.json").write_text('{"type": "reward_classifier", "push_to_hub": false}')


def sounds(folder: Path) -> None:
    """Of `silent`: a file for each episode, at two rates, and one of the session with times of its episodes."""
    for rate, place in ((16000, folder), (11025, folder / "odd")):
        write_sounds(place, rate)
    write_audio(folder / "day.wav", np.zeros((16000 * 5, 1), np.int16), 16000)
    (folder / "starts.csv").write_text("0,1\n1,2\n2,3\n")


MAKERS: dict[str, Callable[[Path], object]] = {
    "full": lambda folder: (folder.mkdir(), (folder / "thesis.tex").touch()),
    "file": Path.touch,
    "folder_mp4": Path.mkdir,
    "slow": with_noise(fps=10),
    "48_kHz": with_noise(sample_rate=48000),
    "six_joints": with_noise(state_size=6),
    "deaf": with_noise(microphones=()),
    "untagged": lambda root: make_dataset(root, (5,), features=without("intervention")),
    "uncorrected": lambda root: rollout_dataset(root, (5,), lambda step: False),
    "act": lambda folder: (folder.mkdir(), ACTConfig(device="cpu", push_to_hub=False).save_pretrained(folder)),
    "empty": lambda root: LeRobotDataset.create("t/empty", 20, without(), root=root, use_videos=False).finalize(),
    "truncated": truncated,
    "dangling": dangling,
    "nowhere": nowhere,
    "reward": reward,
    "sounds": sounds,
}


class Places(dict):
    """Where what rows name in braces is; made when it is named first."""

    def __missing__(self, name: str) -> Path:
        place = self["made"] / name.replace("_", ".")
        MAKERS[name](place)
        self[name] = place
        return place


@pytest.fixture(scope="module")
def places(noise, silent, recorded, trained, finished, tmp_path_factory):
    made = {"noise": noise, "silent": silent, "demos": recorded, "policy": trained, "finished": finished}
    return Places(made, made=tmp_path_factory.mktemp("made"))


def rows_of(table: str) -> list:
    rows = [tuple(row.split(" | ")) for row in table.strip().splitlines() if not row.startswith("#")]
    return [pytest.param(which, what, said, id=f"{which}, {what}") for which, what, *said in rows]


@pytest.mark.parametrize(("base", "changes", "said"), rows_of(COMMANDS))
def test_a_refusal_names_the_option_the_value_and_what_works(base, changes, said, commands, places, tmp_path):
    places["out"] = tmp_path
    command, *options = shlex.split(BASE[base].format_map(places))
    given = {option.partition("=")[0]: option for option in options}
    environment = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    for change in shlex.split(changes.format_map(places)):
        name, _, value = change.partition("=")
        if re.match("-[a-z]", name):
            del given[f"-{name}"]
        elif name.isupper():
            environment[name] = value
        else:
            given[name] = change
    result = commands.run(command, *given.values(), environment=environment)
    message = result.output[result.output.find("error: ") :]
    for text in said:
        assert re.sub(r"\{(\w+)\}", lambda name: str(places.get(name[1], name[0])), text) in message
    assert result.status > 0
    assert "Traceback" not in message
    assert not list(tmp_path.iterdir()), "something was written"


@pytest.mark.parametrize(("function", "arguments", "said"), rows_of(CALLS))
def test_whoever_calls_the_package_is_told_too(function, arguments, said):
    given = yaml.safe_load(f"[{arguments}]" if function == "reset" else f"{{{arguments}}}")
    with pytest.raises(Exception) as refused:  # noqa: PT011  (what is asserted is what it says)
        FUNCTIONS[function](*given) if isinstance(given, list) else FUNCTIONS[function](**given)
    for text in said:
        assert text in str(refused.value)
    assert not Path("never").exists()
