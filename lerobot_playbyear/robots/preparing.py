"""What happens before an attempt: everything is connected, the arm at rest, the scene set up, and the person ready."""

from collections.abc import Callable

import numpy as np

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.robots.parts import RobotError
from lerobot_playbyear.robots.person import Person
from lerobot_playbyear.robots.rig import Rig
from lerobot_playbyear.teleoperation.controls import PersonLeftError


def prepare(rig: Rig, person: Person, seed: int | None, look: Callable[[], np.ndarray]) -> None:
    """Arm at rest, scene set up, person ready.

    Args:
        rig: Connected.
        person: Who is asked before the arm moves, and when the attempt shall begin.
        seed: For a simulated robot, which sets its scene up by itself.
        look: What the cameras see.

    Raises:
        RobotError: Something does not answer.
        PersonLeftError: They leave.
    """
    config = rig.config
    rest = config.rest if config.rest is not None else rig.home or {}
    person.begin()
    if rig.arm.is_away_from(rest):
        if config.wait_for_person:
            person.wait_for("Press P to let the arm go to its rest pose", look)
        if not rig.arm.move_to(rest, config.rest_s, person.wants_to_stop):
            raise PersonLeftError
    rig.arm.begin_episode(seed)
    if config.wait_for_person:
        person.wait_for("Set the scene up, then press P to begin", look)
    person.begins()


def connect_or_ask(rig: Rig, person: Person) -> None:
    """Connects to whatever is not connected, as often as the person wants it.

    Raises:
        PlaybyearError: It cannot be connected, and nobody wants to try again.
    """
    connect = rig.connect
    while True:
        try:
            connect()
            return
        except PlaybyearError as error:
            ask_to_try_again(person, error)
            connect = rig.connect_anew if isinstance(error, RobotError) else rig.connect


def ask_to_try_again(person: Person, error: PlaybyearError) -> None:
    """Returns if the person wants it, and raises the error otherwise."""
    warning = " Hold the arm: it may let go of its joints." if isinstance(error, RobotError) else ""
    if not person.is_there or not person.wants_again(f"{error}{warning}"):
        raise error
