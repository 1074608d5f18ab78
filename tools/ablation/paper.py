"""The figures of the paper's ablations, to stand beside ours.

Buehler et al., "Preface: A Data-driven Volumetric Prior for Few-shot Ultra High-resolution Face Synthesis", ICCV
2023, with its supplementary material. Each is the mean over six held-out views of three held-out people, cropped to
the face, after finetuning at 1024x1024; to two views of them where the table says nothing else. The prior is of 1450
people at 512x768 unless the row says otherwise. The paper does not say which network its LPIPS is of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

METRICS = ("psnr", "ssim", "lpips")
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False}
Row = Mapping[str, float]


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper: where it is, and its figures by row."""

    source: str
    rows: Mapping[str, Row]


def _rows(figures: Mapping[str, Sequence[float]]) -> dict[str, Row]:
    return {name: dict(zip(METRICS, values, strict=True)) for name, values in figures.items()}


def _mean_rows(subjects: Mapping[str, Sequence[Sequence[float]]]) -> dict[str, Row]:
    """Means over subjects A, B and C, which is all that the paper lists of this table."""
    return _rows({name: [sum(values) / len(values) for values in row] for name, row in subjects.items()})


PAPER: Mapping[str, PaperTable] = {
    "initialisation": PaperTable(
        "Ablation on various types of initialising w_target when finetuning (main paper)",
        _rows(
            {
                "furthest": (23.91, 0.7876, 0.2041),
                "nearest": (24.41, 0.7900, 0.2002),
                "mean": (24.61, 0.7934, 0.1959),
                "noise": (24.66, 0.7957, 0.1998),
                "zeros": (24.65, 0.7941, 0.1944),
                "inversion": (25.69, 0.8040, 0.1905),
            }
        ),
    ),
    "regularisers": PaperTable(
        "Ablation on regularisation when finetuning the model (supplementary material)",
        _rows(
            {
                "none": (23.91, 0.7787, 0.2233),
                "normals": (24.79, 0.7839, 0.2066),
                "view weights": (25.53, 0.7996, 0.1963),
                "both": (25.69, 0.8040, 0.1905),
            }
        ),
    ),
    "views": PaperTable(
        "Ablation on the performance for different number of views (supplementary material)",
        _rows(
            {
                "1": (23.37, 0.7658, 0.2189),
                "2": (25.69, 0.8040, 0.1905),
                "3": (27.16, 0.8275, 0.1675),
                "5": (28.33, 0.8445, 0.1651),
                "7": (29.24, 0.8600, 0.1539),
            }
        ),
    ),
    "frozen-latent": PaperTable(
        "Finetuning with and without the latent code, mean of subjects A, B and C (supplementary material)",
        _mean_rows(
            {
                "frozen": ((26.07, 27.21, 22.90), (0.7949, 0.8000, 0.7998), (0.1823, 0.1651, 0.2126)),
                "optimised": ((26.55, 27.30, 23.22), (0.8113, 0.7996, 0.8009), (0.1962, 0.1650, 0.2102)),
            }
        ),
    ),
    "identities": PaperTable(
        "Ablation on the prior model (supplementary material), number of training identities",
        _rows(
            {
                "15": (24.25, 0.7917, 0.2187),
                "350": (24.62, 0.7926, 0.1985),
                "750": (25.43, 0.7935, 0.2035),
                "1450": (25.69, 0.8040, 0.1905),
            }
        ),
    ),
    "resolution": PaperTable(
        "Ablation on the prior model (supplementary material), resolution of the prior's images",
        _rows({"256x384": (25.99, 0.8034, 0.1810), "512x768": (25.69, 0.8040, 0.1905)}),
    ),
}
