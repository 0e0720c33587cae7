"""What can go wrong with writing a dataset."""


class DatasetWriteError(RuntimeError):
    """An episode could not be written; the episodes saved before it are complete on disk.

    Attributes:
        can_be_repeated: Whether the episode is still there: `save_episode` can be called again.
    """

    def __init__(self, message: str, can_be_repeated: bool = False) -> None:
        super().__init__(message)
        self.can_be_repeated = can_be_repeated
