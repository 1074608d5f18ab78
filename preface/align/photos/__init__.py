"""One to seven photographs of one still person from one phone: cameras and face in one adjustment.

Reading order: `face` (what a face is), `projection` (how it appears), `noise` (what landmarks are worth),
`adjustment` (the most probable scene), `initial` (first poses), `solve` (which choices are made), `measure` and
`trust` (what is known), `given` (cameras that are known already), `align` (the entry).
"""

from preface.align.photos.align import align_photos
from preface.align.photos.views import PhotoAlignment, PhotoOptions, PhotoView, Trust

__all__ = ["PhotoAlignment", "PhotoOptions", "PhotoView", "Trust", "align_photos"]
