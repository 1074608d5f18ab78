"""Wrong usage that only shows once the input has been looked at."""


class UsageError(ValueError):
    """Flags that contradict each other or the capture; a command then ends with exit status 2."""
