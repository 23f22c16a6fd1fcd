class Heartbeat:
    """Thread that writes the age of the current step to a file descriptor, without the GIL.

    Each heartbeat is a native double in seconds; 0 between steps. If a heartbeat cannot be written
    without waiting, it is skipped.
    """

    def __init__(self, fd: int, period_s: float) -> None: ...
    def begin(self) -> None:
        """Mark the start of a step."""
    def end(self) -> None:
        """Mark the end of a step."""
    def stop(self) -> None:
        """End the thread and wait for it."""
