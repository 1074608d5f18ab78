"""The user's own assets: found, checked before anything is written, chosen to suit, and worn."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from made_up_assets import proxy_fields, write_proxy, write_sheet, write_skin

from preface.artifacts import ArtifactError
from preface.capture.images import ImageError
from preface.geometry import Camera
from synthetic_studio.assets import Iris, check_assets, choose, read_library
from synthetic_studio.cards import make_cards
from synthetic_studio.cli import main
from synthetic_studio.facemesh import look_at
from synthetic_studio.heads import build_head
from synthetic_studio.identity import HAIR_STYLES, Identity, sample_identity
from synthetic_studio.painted_skin import iris_colour
from synthetic_studio.proxies import HM08_VERTEX_COUNT, read_proxy
from synthetic_studio.render import HeadRenderer
from synthetic_studio.template import EYE_RANGES

TEMPLE = 5399  # an hm08 vertex beside the eye
# hm08 vertices between which MakeHuman measures x, y and z, and their distances in decimetres.
MEASURED = ((5399, 11998, 1.4800), (791, 881, 2.3298), (962, 5320, 1.9221))
PERSON = Identity(
    index=0,
    phenotypes={"gender": 0.9, "age": 0.7, "african": 0.1, "asian": 0.8, "caucasian": 0.1},
    **{name: {} for name in ("controls", "actions")},
    **dict.fromkeys(("melanin", "redness", "freckles", "hair_length", "brow_density", "pupil"), 0.5),
    **dict.fromkeys(("stubble", "yaw", "pitch", "roll"), 0.0),
    hairline=0.066,
    hair_style="short",
    hair_colour="brown",
    iris="blue",
    offset=(0.0, 0.0, 0.0),
    garment=(0.1, 0.1, 0.1),
)


def body(stretch=(1.0, 1.0, 1.0)):
    """A made-up body of random points, as large as the base body times ``stretch``, in metres."""
    vertices = np.random.default_rng(1).uniform(-1.0, 1.0, (HM08_VERTEX_COUNT, 3))
    for axis, (a, b, decimetres) in enumerate(MEASURED):
        vertices[b, axis] = vertices[a, axis] + 0.1 * decimetres * stretch[axis]
    return vertices


def chosen(library, person=PERSON, seed=0):
    return choose(library, person, np.random.default_rng(seed))


def complete(root):
    """A folder with one asset of every kind."""
    write_skin(root, "young_asian_male")
    for kind in ("hair", "eyebrows", "eyes"):
        write_sheet(root, kind, f"blue_{kind}")
    return root


# ------------------------------------------------------------------------------------ the fit


def test_a_proxy_follows_three_vertices_of_the_body_and_its_offsets_follow_the_body_size(tmp_path):
    random = np.random.default_rng(2)
    fields = proxy_fields([0] * 4, random.normal(0, 0.1, (4, 3)), [(0, 1, 2, 3)], np.zeros((4, 2)), ["a"])
    fields["ref_vIdxs"] = random.integers(0, HM08_VERTEX_COUNT, (4, 3)).tolist()
    fields["weights"] = random.dirichlet((1, 1, 1), 4).tolist()
    path = write_proxy(tmp_path, "hair", "a", fields, {"a": np.zeros((2, 2, 4), np.uint8)})
    stretch = (1.1, 0.9, 1.3)
    points = body(stretch)
    fitted = read_proxy(path).fit(points)
    for k in range(4):
        mean = sum(w * points[v] for w, v in zip(fields["weights"][k], fields["ref_vIdxs"][k], strict=True))
        offset = 0.1 * np.array(fields["offsets"][k]) * stretch  # decimetres
        np.testing.assert_allclose(fitted[k], mean + offset, atol=1e-12)


def test_all_face_encodings_of_three_js_are_understood(tmp_path):
    fields = proxy_fields([0] * 4, np.zeros((4, 3)), [], [[0, 0], [1, 0], [1, 1], [0, 1]], ["a"])
    fields["faces"] = [
        *(8, 0, 1, 2, 0, 1, 2),  # a triangle
        *(8 + 2, 0, 2, 3, 7, 0, 2, 3),  # with a material
        *(8 + 2 + 1, 0, 1, 2, 2, 7, 0, 1, 2, 2),  # a triangle written as a quad
        *(8 + 16 + 32 + 64 + 128, 1, 2, 3, 1, 2, 3, 9, 9, 9, 9, 9, 9, 9, 9),  # with normals and colours
    ]
    path = write_proxy(tmp_path, "hair", "a", fields, {"a": np.zeros((2, 2, 4), np.uint8)})
    proxy = read_proxy(path)
    np.testing.assert_array_equal(proxy.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2], [1, 2, 3]])
    # Rows of the image run downwards.
    np.testing.assert_allclose(proxy.corner_uvs[0], [[0, 1], [1, 1], [1, 0]])


def test_quads_are_smoothed_and_triangles_are_left_as_they_are(tmp_path):
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [triangle for a, b, c, d in quads for triangle in ((a, b, c, c), (a, c, d, d))]
    image = {"a": np.zeros((2, 2, 4), np.uint8)}
    spread = {}
    for name, faces in (("quads", quads), ("triangles", triangles)):
        fields = proxy_fields([0] * 8, cube, faces, np.zeros((8, 2)), ["a"])
        proxy = read_proxy(write_proxy(tmp_path, "hair", name, fields, image))
        cards = make_cards(proxy, cube, np.ones((8, 2)), np.ones(8), np.zeros((2, 2, 4), np.float32))
        distance = np.linalg.norm(cards.vertices, axis=1)
        spread[name] = np.ptp(distance) / distance.mean()
        assert cards.corner_uvs.shape == (len(cards.triangles), 3, 2)
        assert ((cards.vertices * cards.normals).sum(axis=1) > 0).all()
        assert len(cards.light) == len(cards.clearance) == len(cards.vertices)
    assert spread["quads"] < 0.25
    np.testing.assert_allclose(cards.vertices, cube)


# ------------------------------------------------------------------------------------ finding and checking


@pytest.mark.parametrize("below", [".", "public", "public/data"])
def test_assets_are_found_in_the_folder_or_up_to_two_levels_below(tmp_path, below):
    complete(tmp_path / below)
    library = read_library(tmp_path)
    assert [skin.name for skin in library.skins] == ["young_asian_male"]
    assert library.missing() == []


def test_a_folder_without_assets_is_refused_with_a_remedy(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit) as stop:
        main([f"--output={tmp_path / 'studio'}", f"--assets={tmp_path / 'empty'}"])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert f"--assets {tmp_path / 'empty'}" in message
    assert "name the folder" in message
    assert not (tmp_path / "studio").exists()


def test_one_warning_names_the_kinds_that_are_missing(tmp_path, caplog):
    write_skin(tmp_path, "young_asian_male")
    write_skin(tmp_path, "plain", colour=(1, 2, 3))
    with caplog.at_level(logging.WARNING):
        check_assets(tmp_path)
    (record,) = caplog.records
    assert "hair, eyebrows, eyes" in record.getMessage()
    assert "skins" not in record.getMessage()


def test_a_complete_folder_raises_no_warning(tmp_path, caplog):
    check_assets(complete(tmp_path))
    assert not caplog.records


def cut(fields):
    fields["faces"] = fields["faces"][:-2]


BREAKAGES = {
    "ref_vIdxs": [
        lambda fields: fields["ref_vIdxs"][1].__setitem__(2, HM08_VERTEX_COUNT),
        lambda fields: fields["ref_vIdxs"][1].__setitem__(2, -1),
        lambda fields: fields["ref_vIdxs"][1].__setitem__(0, 0.5),
        lambda fields: fields.pop("ref_vIdxs"),
        lambda fields: fields.update(ref_vIdxs=[]),
    ],
    "weights": [
        lambda fields: fields["weights"].pop(),
        lambda fields: fields.update(weights=[1, 2, 3]),
        lambda fields: fields["weights"][0].pop(),
    ],
    "offsets": [lambda fields: fields.update(offsets="none")],
    "uvs": [lambda fields: fields.update(uvs=[])],
    "faces": [
        cut,
        lambda fields: fields.update(faces=[]),
        lambda fields: fields.update(faces=[1, 0, 1, 2, 3]),
        lambda fields: fields["faces"].__setitem__(1, 99),
        lambda fields: fields["faces"].__setitem__(-1, 99),
        lambda fields: fields["faces"].__setitem__(1, -1),
        lambda fields: fields["uvs"][0].pop(),
    ],
    "materials": [lambda fields: fields.update(materials=[]), lambda fields: fields.pop("materials")],
    "materials[0].mapDiffuse": [
        lambda fields: fields["materials"][0].update(mapDiffuse="textures/lost.png"),
        lambda fields: fields["materials"][0].update(mapDiffuse=3),
    ],
}


@pytest.mark.parametrize(
    ("field", "damage"), [(field, damage) for field, damages in BREAKAGES.items() for damage in damages]
)
def test_a_broken_proxy_is_refused_by_file_field_and_remedy(tmp_path, field, damage):
    path = write_sheet(tmp_path, "hair", "bob01")
    fields = json.loads(path.read_text())
    damage(fields)
    path.write_text(json.dumps(fields))
    with pytest.raises(ArtifactError) as caught:
        read_library(tmp_path)
    assert caught.value.path == path
    assert caught.value.field == field
    assert caught.value.remedy


@pytest.mark.parametrize("broken", ["text", "texture", "skin"])
def test_broken_files_stop_the_studio_before_any_image(tmp_path, capsys, broken):
    assets = complete(tmp_path / "assets")
    if broken == "text":
        bad = assets / "proxies" / "eyebrows" / "blue_eyebrows" / "blue_eyebrows.json"
        bad.write_text(bad.read_text()[:-9])
    elif broken == "texture":
        bad = assets / "proxies" / "eyes" / "blue_eyes" / "textures" / "blue_eyes.png"
        bad.write_bytes(bad.read_bytes()[:40])
    else:
        bad = assets / "skins" / "young_asian_male" / "young_asian_male.json"
        bad.write_text('{"mapDiffuse": "nowhere.png"}')
    for dry in ([], ["--dry-run"]):
        status = main([f"--output={tmp_path / 'studio'}", f"--assets={assets}", *dry])
        assert status == 1
        assert str(bad) in capsys.readouterr().err
        assert not (tmp_path / "studio").exists()


def test_an_unreadable_texture_is_an_image_error(tmp_path):
    path = write_skin(tmp_path, "young_asian_male")
    (path.parent / "textures" / "skin.png").write_bytes(b"not an image")
    with pytest.raises(ImageError, match=r"skin\.png"):
        check_assets(tmp_path)


# ------------------------------------------------------------------------------------ choosing


def test_a_skin_suits_sex_then_age_and_ancestry_and_is_not_a_costume(tmp_path):
    for age in ("young", "middleage", "old"):
        for ancestry in ("african", "asian", "caucasian"):
            for sex in ("female", "male"):
                write_skin(tmp_path, f"{age}_{ancestry}_{sex}")
    write_skin(tmp_path, "young_asian_male_special_suit")
    library = read_library(tmp_path)
    assert {chosen(library, seed=seed).skin.name for seed in range(8)} == {"young_asian_male"}
    old = replace(PERSON, phenotypes=PERSON.phenotypes | {"age": 0.95, "gender": 0.1, "african": 0.9})
    assert chosen(library, old).skin.name == "old_african_female"


def test_when_nothing_suits_the_sex_still_counts_most(tmp_path):
    write_skin(tmp_path, "young_asian_female")
    write_skin(tmp_path, "old_african_male")
    assert chosen(read_library(tmp_path)).skin.name == "old_african_male"


def test_hair_suits_the_style_and_beards_are_no_hair(tmp_path):
    for name, tags in {
        "bob01": ["female"],
        "short01": ["male", "short"],
        "short02": ["short", "male"],
        "Full_beard": ["male", "beard", "short"],
        "afro01": [],
        "long01": ["long", "female"],
    }.items():
        write_sheet(tmp_path, "hair", name, tags)
    library = read_library(tmp_path)
    worn = {seed: chosen(library, seed=seed).hair.name for seed in range(20)}
    assert set(worn.values()) == {"short01", "short02"}
    woman = replace(PERSON, phenotypes=PERSON.phenotypes | {"gender": 0.1})
    names = {
        style: one.hair and one.hair.name
        for style in HAIR_STYLES
        if (one := chosen(library, replace(woman, hair_style=style)))
    }
    assert names["bald"] is None
    assert (names["bob"], names["long"], names["curly"]) == ("bob01", "long01", "afro01")


def test_irises_are_chosen_by_the_colour_of_their_names(tmp_path):
    images = {name: np.zeros((4, 4, 4), np.uint8) for name in ("brown_eye", "blue_eye", "lightblue_eye")}
    fields = proxy_fields([0] * 4, np.zeros((4, 3)), [(0, 1, 2, 3)], np.zeros((4, 2)), list(images))
    write_proxy(tmp_path, "eyes", "low", fields, images)
    library = read_library(tmp_path)
    assert {chosen(library, seed=seed).iris.texture.stem for seed in range(20)} == {
        "blue_eye",
        "lightblue_eye",
    }
    dark = replace(PERSON, iris="dark_brown")
    assert chosen(library, dark).iris.texture.stem == "brown_eye"


def test_the_colour_of_an_iris_is_read_where_the_eye_looks_ahead(tmp_path):
    # An eye of radius 1.6 cm about a body's eye vertices, seen straight on, painted with one disc.
    points, side = body(), np.random.default_rng(3).normal(size=(72, 3))
    centre = np.array([0.031, 0.9, 0.1])
    points[slice(*EYE_RANGES["left"])] = centre + 0.016 * side / np.linalg.norm(side, axis=1, keepdims=True)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.01, 0.01, 9)] * 2), axis=-1).reshape(-1, 2)
    sphere = np.c_[grid, np.sqrt(0.016**2 - (grid**2).sum(axis=1))]
    offsets = 10.0 * (centre + sphere - points[TEMPLE])  # decimetres on a body of the base's size
    faces = [(9 * j + i, 9 * j + i + 1, 9 * j + i + 10, 9 * j + i + 9) for j in range(8) for i in range(8)]
    uvs = 0.5 + 25.0 * grid @ [[0.0, 1.0], [-1.0, 0.0]]  # turned by a right angle, as textures may be
    rows, columns = np.mgrid[:256, :256]
    radius = np.hypot(rows - 127.5, columns - 127.5) / 256 / 25.0  # metres
    image = np.full((256, 256, 4), (240, 235, 230, 255), np.uint8)
    image[radius < 0.0056, :3] = (30, 60, 110)
    image[radius < 0.0022, :3] = 0
    fields = proxy_fields([TEMPLE] * 81, offsets, faces, uvs, ["blue"])
    proxy = read_proxy(write_proxy(tmp_path, "eyes", "eye", fields, {"blue": image}))
    colour = iris_colour(Iris(proxy, proxy.textures["blue"]), points)
    np.testing.assert_allclose(colour, [0.0130, 0.0452, 0.1559], rtol=0.02)


# ------------------------------------------------------------------------------------ wearing them


@pytest.fixture(scope="module")
def dressed(tmp_path_factory):
    """A head with green skin and a sheet of hair far to its left, no other assets, and the folder."""
    assets = tmp_path_factory.mktemp("assets")
    write_skin(assets, "young_asian_male", colour=(40, 160, 40))
    write_sheet(assets, "hair", "short01", at=(2.0, 0.0, 0.0))
    index = next(k for k in range(50) if sample_identity(0, k).hair_style not in ("bald", "bun"))
    return build_head(0, index, assets)


@pytest.fixture(scope="module")
def front(dressed):
    camera = Camera("PINHOLE", 96, 96, np.array([150.0, 150.0, 48.0, 48.0]))
    return HeadRenderer(dressed).render(camera, look_at(0.0, 0.0), 1)


def test_the_parameters_say_which_assets_were_worn(dressed):
    assert dressed.parameters["assets"] == {
        "skin": "young_asian_male",
        "hair": "short01",
        "eyebrows": None,
        "iris": None,
    }
    json.dumps(dressed.parameters, allow_nan=False)


def test_own_hair_replaces_the_strands_on_the_scalp_and_missing_brows_are_grown(dressed):
    eyes = np.mean([ball.centre for ball in dressed.eyeballs.values()], axis=0)
    roots = dressed.strands.points[:, 0] - eyes
    assert not (roots[:, 1] > 0.05).any()  # nothing grows on the scalp
    brows = (roots[:, 1] > 0.012) & (roots[:, 2] > 0)
    assert brows.sum() > 200
    assert len(dressed.cards) == 1


def test_the_skin_shows_the_texture_and_the_shirt_does_not(dressed, front):
    nose = dressed.keypoints["nose_tip"]
    row, column = int(48 - 150 * nose[1]), int(48 + 150 * nose[0])
    red, green, blue = front.radiance[row, column]
    assert green > 2 * max(red, blue)
    garment = np.array(dressed.parameters["garment"])
    shirt = front.radiance[-3, 40:56].mean(axis=0)
    np.testing.assert_allclose(shirt / shirt.sum(), garment / garment.sum(), atol=0.05)


def test_the_hair_is_seen_with_its_depth_where_the_proxy_puts_it(dressed, front):
    middle = dressed.cards[0].vertices.mean(axis=0)
    row, column = int(48 - 150 * middle[1]), int(48 + 150 * middle[0] / (1.0 - middle[2]))
    assert front.alpha[row, column] == 1.0
    assert front.depth[row, column] == pytest.approx(1.0 - middle[2], abs=0.01)
    colour = front.radiance[row, column]
    assert colour.min() > 0.0
    assert colour[1] < 0.2  # hair, not the green skin
