"""Keys in a bag: hidden from the camera, found by touch, heard; what ends an attempt, and what else can be in the bag."""

import itertools

import numpy as np
import pytest
from support.playing import STILL, Still, finish, make

from gym_playbyear.experts.key_bag import BagExpert
from gym_playbyear.tasks.bag import BAG, CONTENTS, CONTENTS_KINDS, HALF_SIZE, RIM, middle_of

EASY, HARD = "KeyBag-Easy-v1", "KeyBag-Hard-v1"


def points_of(env) -> np.ndarray:
    """Corners of the boxes around all that is in the bag (N, 3) [m, world]."""
    model, data = env.model, env.data
    parts = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body(CONTENTS).id)
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    local = model.geom_aabb[parts, None, :3] + corners * model.geom_aabb[parts, None, 3:]  # (G, 8, 3)
    turned = np.einsum("gij,gpj->gpi", data.geom_xmat[parts].reshape(-1, 3, 3), local)
    return (data.geom_xpos[parts][:, None] + turned).reshape(-1, 3)


def test_the_camera_sees_no_keys_before_they_are_lifted():
    world, twin = make(HARD, image_size=84), make(HARD, image_size=84, hidden_object=False)
    first, second = world.reset(seed=0)[0], twin.reset(seed=0)[0]
    expert, n_steps = world.scripted_expert(), 0
    while world.contact_forces[f"gripper-{CONTENTS}"] == 0 and n_steps < 25:
        np.testing.assert_array_equal(first["pixels"]["front"], second["pixels"]["front"])
        np.testing.assert_array_equal(first["agent_pos"], second["agent_pos"])
        action, n_steps = expert.act(), n_steps + 1
        first, second = world.step(action)[0], twin.step(action)[0]
    assert 5 < n_steps < 25


@pytest.mark.parametrize("kind", CONTENTS_KINDS)
def test_whatever_lies_in_the_bag_is_below_what_the_camera_sees(kind):
    env = make(EASY, contents=kind)
    eye = env.model.camera("front").pos
    x, y = HALF_SIZE
    for seed in range(2):
        env.reset_physics(seed=seed, options={"bottom": env.definition.numbers.bottom[1]})
        points = points_of(env)
        assert (np.abs(points[:, 0]) < x).all()
        assert (np.abs(points[:, 1]) < y).all()
        share = (eye[0] - x) / (eye[0] - points[:, 0])  # of the way from the eye to a point, where the front wall is
        assert (eye[2] + share * (points[:, 2] - eye[2]) < RIM).all()


@pytest.mark.parametrize("kind", [kind for kind in CONTENTS_KINDS if kind != "keys"])
def test_the_expert_takes_other_things_out(kind):
    env = make(EASY, contents=kind)
    env.reset_physics(seed=2001)
    assert finish(env, env.scripted_expert())["end"] == "success"
    assert middle_of(env)[2] > RIM


def test_what_is_too_long_for_the_fingers_lies_across_them():
    env = make(EASY, contents="pens")
    extents = []
    for seed in range(6):
        env.reset_physics(seed=seed)
        extents.append(np.ptp(points_of(env)[:, :2], axis=0))
    assert (np.array(extents)[:, 0] > np.array(extents)[:, 1]).all()  # fingers open along y


def test_what_ends_an_attempt():
    env = make(EASY)
    for expected, options, actions in (
        ("torn", {"bottom": 0.06}, [(0, 0, -0.4, -1)]),
        ("groped", {}, [(0, 0, 0, 1), (0, 0, 0, -1)]),
        ("time", {}, [(0, 0, 0, -1)]),
    ):
        env.reset_physics(seed=0, options={"contents_position": (0.04, 0.09), **options})
        done, steps = False, 0
        while not done:
            _, terminated, truncated, info = env.step_physics(actions[steps // 11 % len(actions)])
            steps, done = steps + 1, terminated or truncated
        assert info["end"] == expected


def test_walls_bend_visibly_and_crackle():
    env = make(EASY, sound="waveform", noise_level=0.0, hidden_object=False, image_size=84)
    picture = env.reset(seed=0, options={"bottom": 0.03})[0]["pixels"]["front"].astype(int)
    for _ in range(8):
        env.step_physics(np.array([0, 0, -0.4, -1.0]))
    still = env.step(STILL)[0]["audio.gripper"]
    louder, bent = 0.0, 0.0
    for _ in range(6):
        observation = env.step(np.array([0, 0.6, 0, -1.0]))[0]
        louder = max(louder, float(np.abs(observation["audio.gripper"].astype(float)).mean()))
        bent = max(bent, float(abs(env.data.joint("left_foot").qpos[0])))
    assert bent > 0.05
    assert louder > 10 * np.abs(still.astype(float)).mean() + 10
    changed = np.abs(observation["pixels"]["front"].astype(int) - picture).max(axis=-1) > 20
    assert changed[45:, 60:].sum() > 10  # below the hand, where only the bag is


def test_one_hears_the_bottom():
    """Pressed as slowly as the expert does; at the usual background, and beside the keys."""
    env, louder = make(EASY, sound="waveform"), []
    for seed in range(4):
        observation, peaks = env.reset(seed=seed, options={"contents_position": (-0.05, -0.10), "bottom": 0.06})[0], []
        while env.contact_forces[f"gripper-{BAG}"] < 0.5:
            down = -0.08 if env.eef_position[2] < RIM else -0.5
            observation = env.step(np.array([0.0, 0.0, down, -1.0]))[0]
            peaks.append(np.abs(observation["audio.gripper"].astype(float)).max())
        louder.append(20 * np.log10(peaks[-1] / np.median(peaks[-9:-1])))
    assert np.median(louder) > 20  # dB
    assert min(louder) > 10


@pytest.mark.slow
def test_one_hears_which_finger_touches_the_keys():
    env, louder = make(HARD, sound="waveform"), []
    for seed in (3, 4, 5):
        for side, near, far in ((-1, "left_finger", "right_finger"), (1, "right_finger", "left_finger")):
            env.reset(seed=seed, options={"contents_position": (0.0, side * 0.033)})
            expert = env.scripted_expert()
            while env.contact_forces[f"gripper-{CONTENTS}"] < 0.15:
                observation = env.step(expert.act())[0]
            levels = [np.square(observation[f"audio.{name}"].astype(float)).mean() for name in (near, far)]
            louder.append(levels[0] / levels[1])
            while expert.phase != "lower":
                env.step_physics(expert.act())
            assert side * env.eef_position[1] > 0.01  # the expert went there
    assert min(louder) > 1.5
    assert np.median(louder) > 4


def solves(env, players, most_closings=9) -> bool:
    """Whether at least two of the first three episodes are solved, by what `players` makes: a policy, and a gate."""
    solved = 0
    for seed in range(3):
        env.reset_physics(seed=seed)
        info = finish(env, *players(env))
        solved += info["is_success"] and info["n_closings"] <= most_closings
        if solved == 2:
            return True
    return False


class Felt:
    """An environment of which one gets what the hand feels, and what is the same in every episode."""

    FELT = ("contact_forces", "hand_forces", "eef_position", "finger_positions")
    KNOWN = ("expert_rng", "definition", "microphones")

    def __init__(self, env):
        self._env = env

    def __getattr__(self, name):
        assert name in (*self.FELT, *self.KNOWN), f"the expert looks at {name}"
        return getattr(self._env, name)


@pytest.mark.parametrize("task", [EASY, HARD])
def test_the_expert_acts_on_what_it_felt_alone(task):
    assert solves(make(task), lambda env: (BagExpert(Felt(env)),))


@pytest.mark.slow
def test_the_force_that_stands_for_sound_is_felt_wherever_the_keys_lie():
    """They lie up to 10 cm above the table, where the cube tasks' proxy is silent because their cube was lifted."""
    for bottom in (0.03, 0.095):
        env, info = make(EASY, sound="contact_force"), {"is_success": False}
        for seed in range(1, 6):  # the expert does not solve every scene, and processors round differently
            observation, _ = env.reset(seed=seed, options={"bottom": bottom})
            expert, touches, over = env.scripted_expert(), [], False
            while not over:
                observation, _, terminated, truncated, info = env.step(expert.act())
                touches.append((env.contact_forces[f"gripper-{CONTENTS}"], np.abs(observation["contact_force"]).max()))
                over = terminated or truncated
            if info["is_success"]:
                break
        assert info["is_success"]
        first = next(felt for force, felt in touches if force > 1.0)
        assert first > 0.1
        assert touches[-1][1] == 0.0  # in the air


@pytest.mark.slow
def test_a_cloth_is_mute():
    """To touch it is much quieter than to touch keys."""
    levels = {}
    for kind in ("keys", "cloth"):
        env, heard = make(EASY, sound="waveform", noise_level=0.0, contents=kind), []
        for seed in range(4):
            env.reset(seed=seed)
            expert = env.scripted_expert()
            while expert.phase in ("enter", "descend"):
                observation = env.step(expert.act())[0]
                if env.contact_forces[f"gripper-{CONTENTS}"] > 0.15:
                    heard.append(np.square(observation["audio.gripper"].astype(float)).mean())
                    break
        levels[kind] = np.median(heard)  # a finger may meet the bag in the same step, which crackles
    assert levels["cloth"] < 0.2 * levels["keys"]


@pytest.mark.slow
def test_a_bad_policy_is_corrected():
    """Someone who waits far above the keys."""
    env, rescued, seed = make(EASY), False, 0
    while not rescued and seed < 4:
        env.reset_physics(seed=seed)
        rescued, seed = finish(env, Still(), env.intervention_gate())["is_success"], seed + 1
    assert rescued


class PressesOn:
    """Comes down as the expert does, and then presses on; with something in the hand it lifts it."""

    def __init__(self, env):
        self.env, self.expert = env, env.scripted_expert()

    def act(self) -> np.ndarray:
        if self.env.finger_positions.sum() < 0.9 * self.env.definition.arm.max_opening:
            return np.array([0, 0, 0.4 if self.env.eef_position[2] < RIM + 0.05 else 0, 1.0])
        return self.expert.act() if self.expert.phase in ("enter", "descend") else np.array([0, 0, -0.08, -1.0])


def test_who_lands_on_the_keys_and_goes_on_is_led_beside_them():
    """Where one closing takes them out, at once."""
    assert solves(make(HARD), lambda env: (PressesOn(env), env.intervention_gate()), most_closings=1)


def test_a_policy_as_good_as_the_expert_is_left_alone():
    env = make(EASY)
    env.reset_physics(seed=2)
    assert finish(env, env.scripted_expert(), env.intervention_gate())["by_expert"].mean() < 0.2
