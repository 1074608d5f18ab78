"""The error of the alignment layer."""


class AlignmentError(ValueError):
    """Landmarks, cameras or a template that do not belong together; the message says the remedy."""
