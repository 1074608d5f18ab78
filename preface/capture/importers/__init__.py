"""Public datasets become captures with rigs: capture.json, images and masks as a capture has them, and cameras.

    CAPTURE/capture.json                        written last
    CAPTURE/subjects/<person>-<frame>/<camera>.*
    CAPTURE/masks/<person>-<frame>/<camera>.*   where the dataset has masks
    CAPTURE/rigs/<take>.json                    for `preface-align studio CAPTURE --rig CAPTURE/rigs`

Each frame of a person is a subject of its own, since a subject is one instant. Frames whose cameras are the same
to the last bit share a take, which is named after the first of them. Who a subject is stands in capture.json
under ``metadata.imported.people``, so that a split into people can keep all frames of one together.
"""

from preface.capture.importers.frames import Frame, ImportOptions, LeftOut
from preface.capture.importers.importing import LAYOUTS, Imported, import_dataset

__all__ = ["LAYOUTS", "Frame", "ImportOptions", "Imported", "LeftOut", "import_dataset"]
