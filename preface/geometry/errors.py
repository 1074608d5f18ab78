"""The one error of the geometry layer."""


class GeometryError(ValueError):
    """A camera, pose, box or set of points that cannot mean what it should; the message says the remedy."""
