"""What can go wrong with a robot."""

from lerobot_playbyear.datasets.errors import PlaybyearError


class RobotError(PlaybyearError, RuntimeError):
    """A robot, or something on it, cannot be used; the message says what, and what to do. Nothing saved is lost."""
