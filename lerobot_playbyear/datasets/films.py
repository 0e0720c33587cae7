"""The films of an episode that was encoded while it came in: their pictures are nowhere else."""

import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import av
from lerobot.datasets.video_utils import StreamingVideoEncoder

from lerobot_playbyear.datasets.episode_checks import IncompleteEpisodeError, LostFramesError, check_video
from lerobot_playbyear.datasets.files import take_over


class Film(NamedTuple):
    """One camera's film, and LeRobot's statistics of its pictures."""

    path: Path
    stats: dict[str, Any] | None


def finish_films(encoder: StreamingVideoEncoder, folder: Path, length: int) -> dict[str, Film]:
    """Ends the films of the episode in progress.

    Args:
        encoder: LeRobot's, with an episode in progress.
        folder: Where the films are kept; it is made.
        length: The episode's frames.

    Raises:
        LostFramesError: A film could not be written, or lacks frames.
    """
    films = {}
    try:
        results = encoder.finish_episode()
        for number, (key, (path, stats)) in enumerate(results.items()):
            check_video(path, key, length)
            folder.mkdir(parents=True, exist_ok=True)
            films[key] = Film(folder / f"{number}.mp4", stats)
            os.replace(path, films[key].path)
    except (IncompleteEpisodeError, OSError, RuntimeError, av.FFmpegError) as error:
        raise LostFramesError(str(error)) from error
    return films


class FinishedFilms:
    """Takes the encoder's place for LeRobot when the films are complete: each save gets them anew, as links.

    Args:
        films: The films by key.
        folder: LeRobot's dataset.
    """

    def __init__(self, films: dict[str, Film], folder: Path) -> None:
        self._films, self._folder = films, folder

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, Any] | None]]:
        """The films, each in a folder that LeRobot removes."""
        results = {}
        for key, film in self._films.items():
            path = Path(tempfile.mkdtemp(dir=self._folder)) / film.path.name
            take_over(film.path, path)
            results[key] = (path, film.stats)
        return results

    def cancel_episode(self) -> None:
        """Nothing is in progress."""

    def close(self) -> None:
        """Nothing is open."""
