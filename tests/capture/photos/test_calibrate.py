"""From photographs on disk to a rig: rendered views of an open book whose cameras are known."""

import tempfile

import cv2
import numpy as np
import pytest
from PIL import Image

from preface.capture.images import ImageError, read_image, write_jpeg, write_png
from preface.capture.photos import PhotoError, PhotoOptions, calibrate_photos
from preface.capture.photos.files import find_photographs, stage
from preface.capture.rig import read_rig, write_rig
from preface.geometry.cameras import Camera
from preface.geometry.similarity import fit_similarity
from preface.geometry.transforms import Rigid

WIDTH, HEIGHT, FOCAL, VIEWS = 640, 480, 620.0, 8
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
FOCAL_LENGTH_35MM = 0xA405  # EXIF's tag
TEXELS = 700  # of a page's side, 0.7 m
# A page's corner, and its sides, in the book's frame (x right, y down, z away from the reader).
PAGES = (
    (np.array([-0.6, -0.35, -0.35]), np.array([0.6, 0, 0.35]), np.array([0, 0.7, 0])),
    (np.array([0, -0.35, 0]), np.array([0.6, 0, -0.35]), np.array([0, 0.7, 0])),
)


def page_texture(seed):
    """Dots of many sizes and tones, so that features are found at every scale."""
    random = np.random.default_rng(seed)
    page = np.full((TEXELS, TEXELS), 128, np.uint8)
    for radius in (40, 20, 10, 5, 3):
        for _ in range(6000 // radius**2 + 80):
            spot = tuple(int(v) for v in random.integers(0, TEXELS, 2))
            cv2.circle(page, spot, radius, int(random.integers(0, 256)), -1, cv2.LINE_AA)
    return page


def poses():
    """camera_from_book of a reader walking around, 0.9 to 1.2 m away, always looking at the book."""
    result = []
    for index, angle in enumerate(np.linspace(-0.45, 0.45, VIEWS)):
        distance = 1.05 + 0.15 * np.cos(2.1 * index)
        centre = distance * np.array([np.sin(angle), 0.22 * np.sin(1.7 * index), -np.cos(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        result.append(Rigid(rotation, -rotation @ centre))
    return result


def photograph(camera_from_book):
    """Render the book, [HEIGHT, WIDTH, 1] uint8, four samples a pixel."""
    to_fine = np.array(
        [[2, 0, -0.5], [0, 2, -0.5], [0, 0, 1]]
    )  # OpenCV's pixel centres of an image twice as fine
    image = np.full((2 * HEIGHT, 2 * WIDTH), 90, np.uint8)
    for seed, (corner, across, down) in enumerate(PAGES):
        moved = camera_from_book.rotation @ np.stack([across / TEXELS, down / TEXELS, corner], axis=1)
        moved[:, 2] += camera_from_book.translation
        homography = to_fine @ CAMERA.K @ moved
        texture = page_texture(seed)
        inside = cv2.warpPerspective(np.full_like(texture, 255), homography, image.shape[::-1]) == 255
        image[inside] = cv2.warpPerspective(texture, homography, image.shape[::-1])[inside]
    return cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)[..., None]


@pytest.fixture(scope="module")
def album(tmp_path_factory):
    """Eight photographs of the book: PNG, one of 16 bits and one JPEG among them, and a blank one."""
    folder = tmp_path_factory.mktemp("album")
    for index, pose in enumerate(poses()):
        pixels = photograph(pose)
        if index == 2:
            write_png(folder / f"view{index}.png", pixels.astype(np.uint16) * 257)
        elif index == 5:
            write_jpeg(folder / f"view{index}.jpg", pixels, 95)
        else:
            write_png(folder / f"view{index}.png", pixels)
    write_png(folder / "blank.png", np.full((HEIGHT, WIDTH, 1), 90, np.uint8))
    return folder


@pytest.fixture(scope="module")
def temporary(tmp_path_factory):
    return tmp_path_factory.mktemp("temporary")


@pytest.fixture(scope="module")
def calibration(album, temporary):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(temporary))
        options = PhotoOptions(known_distance=("view0", "view7", true_distance()), max_features=500, folds=3)
        return calibrate_photos(album, options)


def true_centres():
    return np.stack([pose.inverse.translation for pose in poses()])


def true_distance():
    centres = true_centres()
    return float(np.linalg.norm(centres[7] - centres[0]))


# ----------------------------------------------------------------------------------- the pipeline


def test_every_photograph_that_shows_the_book_is_registered_and_the_blank_one_is_explained(calibration):
    assert list(calibration.rig.cameras) == [f"view{index}" for index in range(VIEWS)]
    assert list(calibration.missing) == ["blank"]
    assert "shows 0 features" in calibration.missing["blank"]


def test_cameras_are_where_they_were(calibration):
    centres = np.stack([c.camera_from_rig.inverse.translation for c in calibration.rig.cameras.values()])
    book_from_rig = fit_similarity(centres, true_centres()).target_from_source
    errors = np.linalg.norm(book_from_rig.apply(centres) - true_centres(), axis=1)
    assert errors.max() < 0.005  # metres, at about 1 m
    assert float(book_from_rig.scale) == pytest.approx(1, rel=0.01)


def test_the_lens_is_found_and_shared(calibration):
    lenses = {c.camera for c in calibration.rig.cameras.values()}
    assert len(lenses) == 1
    (lens,) = lenses
    assert lens.intrinsics[:2] == pytest.approx([FOCAL, FOCAL], rel=0.01)
    assert lens.intrinsics[2:4] == pytest.approx([WIDTH / 2, HEIGHT / 2], abs=6)
    assert lens.intrinsics[4] == pytest.approx(0, abs=0.02)


def test_the_known_distance_sets_the_scale_and_the_first_photograph_the_frame(calibration):
    cameras = calibration.rig.cameras
    first, last = (cameras[name].camera_from_rig.inverse.translation for name in ("view0", "view7"))
    assert np.linalg.norm(last - first) == pytest.approx(true_distance())
    assert first == pytest.approx(0, abs=1e-12)
    assert "view0" in calibration.scale
    assert calibration.rig.scale == "metric"
    assert not any("arbitrary" in warning for warning in calibration.warnings)


def test_held_out_sightings_confirm_the_fit(calibration):
    held_out = calibration.rig.held_out_reprojection_error
    chosen = calibration.candidates[calibration.chosen]
    assert chosen.training_error < held_out.rms < 1.0
    assert held_out.count > 500
    assert all(camera.reprojection_error.count > 100 for camera in calibration.rig.cameras.values())


def test_points_lie_on_the_pages(calibration):
    centres = np.stack([c.camera_from_rig.inverse.translation for c in calibration.rig.cameras.values()])
    book = fit_similarity(centres, true_centres()).target_from_source.apply(calibration.structure.points)
    off_page = np.abs(book[:, 2] + 0.35 / 0.6 * np.abs(book[:, 0]))
    assert np.median(off_page) < 0.002


def test_nothing_is_left_behind(calibration, temporary, album):
    assert list(temporary.iterdir()) == []
    assert len(list(album.iterdir())) == VIEWS + 1


def test_the_rig_is_written_with_the_table_of_models(calibration, tmp_path):
    rig = read_rig(write_rig(tmp_path / "rig.json", calibration.rig))
    table = rig.metadata["camera_models"]
    assert [row["model"] for row in table if row["chosen"]] == [rig.cameras["view0"].camera.model]
    assert {"training_rms", "held_out_rms", "objections", "standard_deviations"} <= set(table[0])
    assert rig.metadata["not_registered"] == dict(calibration.missing)


def test_masks_and_single_cameras_are_heeded_and_an_arbitrary_scale_is_said(album, tmp_path):
    images, masks = [album / f"view{index}.png" for index in (0, 1, 3, 4)], tmp_path / "masks"
    masks.mkdir()
    for index in range(4):
        images.append(tmp_path / f"wall{index}.png")
        write_png(images[-1], np.full((60, 80, 1), 90, np.uint8))
    for file in images:
        wanted = file.name != "view4.png"
        write_png(masks / file.name, np.full_like(read_image(file), 255 * wanted))
    options = PhotoOptions(cameras="each", masks=masks, take="book", max_features=1000)
    result = calibrate_photos(images, options)
    assert set(result.rig.cameras) == {"view0", "view1", "view3"}
    assert "masked" in result.missing["view4"]
    assert result.rig.take == "book"
    assert len({camera.camera for camera in result.rig.cameras.values()}) == 3
    said = " ".join(result.warnings)
    assert "arbitrary" in said
    assert result.rig.scale == "arbitrary"
    assert "only 3 of 8 photographs were registered (not view4.png, wall0.png" in said
    assert "at least four photographs" in said
    depths = result.structure.in_cameras(result.tracks)[:, 2]
    assert np.median(depths) == pytest.approx(1)


def test_the_same_seed_gives_the_same_rig_and_a_zoom_between_photographs_is_noticed(album, tmp_path):
    for index, millimetres in {0: 28, 1: 28, 3: 50, 4: 50}.items():
        exif = Image.Exif()
        exif.get_ifd(0x8769)[FOCAL_LENGTH_35MM] = millimetres
        pixels = read_image(album / f"view{index}.png")[..., 0]
        Image.fromarray(pixels).save(tmp_path / f"view{index}.jpg", quality=95, exif=exif)
    options = PhotoOptions(threads=1, seed=3, max_features=400, folds=2)
    once, again = (calibrate_photos(tmp_path, options) for _ in range(2))
    for name, camera in once.rig.cameras.items():
        assert camera.camera.params == pytest.approx(again.rig.cameras[name].camera.params, rel=1e-9)
        assert camera.translation == pytest.approx(again.rig.cameras[name].translation, rel=1e-9, abs=1e-12)
    (zoom,) = (warning for warning in once.warnings if "EXIF" in warning)
    assert "view0.jpg" in zoom
    assert "view4.jpg" in zoom or "view3.jpg" in zoom


# ------------------------------------------------------------------------------------- bad input


def noise(seed, shape=(HEIGHT, WIDTH, 1)):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_photographs_are_too_few(tmp_path, count):
    for index in range(count):
        write_png(tmp_path / f"{index}.png", noise(index))
    with pytest.raises(PhotoError, match=f"holds {count} photograph.*at least two"):
        calibrate_photos(tmp_path)


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(PhotoError, match=r"nowhere.*does not exist"):
        calibrate_photos(tmp_path / "nowhere")


def test_photographs_that_have_nothing_in_common_are_refused(tmp_path):
    for index in range(2):
        write_png(tmp_path / f"{index}.png", noise(index, (120, 160, 1)))
    with pytest.raises(PhotoError, match=r"no two photographs match.*10 degrees apart"):
        calibrate_photos(tmp_path)


def test_one_camera_has_one_size_but_two_may_differ(tmp_path):
    for name, size in {"a": (60, 80), "b": (60, 80), "c": (80, 60)}.items():
        write_png(tmp_path / f"{name}.png", noise(0, (*size, 1)))
    with pytest.raises(PhotoError, match=r"c\.png: size: is 60x80.*are 80x60.*--cameras each"):
        calibrate_photos(tmp_path)
    with pytest.raises(PhotoError, match=r"Give photographs of one size and orientation\.?$"):
        find_photographs(tmp_path, None)
    assert [photo.camera for photo in find_photographs(tmp_path, "each")] == [0, 1, 2]


def test_photographs_that_exif_wants_rotated_are_refused(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    for name in "ab":
        Image.fromarray(noise(0)[..., 0]).save(tmp_path / f"{name}.jpg", exif=exif)
    with pytest.raises(ImageError, match=r"a\.jpg: EXIF orientation"):
        calibrate_photos(tmp_path)


def test_names_that_clash_are_told_apart_by_folder_or_refused(tmp_path):
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        write_png(tmp_path / folder / "0001.png", noise(0, (60, 80, 1)))
    photos = find_photographs(tmp_path, "folder")
    assert [(photo.id, photo.camera) for photo in photos] == [("left-0001", 0), ("right-0001", 1)]
    write_jpeg(tmp_path / "left" / "0001.jpg", noise(0, (60, 80, 1)), 90)
    with pytest.raises(PhotoError, match=r"0001\.png: name: becomes 'left-0001', as .*0001\.jpg"):
        find_photographs(tmp_path, "folder")


def test_a_known_distance_is_between_two_photographs(tmp_path):
    for index in range(2):
        write_png(tmp_path / f"{index}.png", noise(index, (60, 80, 1)))
    for distance, problem in {
        ("0", "7", 1.0): "'7' is no photograph",
        ("0", "1", 0.0): "no distance",
    }.items():
        with pytest.raises(PhotoError, match=problem):
            calibrate_photos(tmp_path, PhotoOptions(known_distance=distance))


def test_a_mask_that_is_missing_or_of_another_size_is_named(tmp_path):
    images, masks = tmp_path / "images", tmp_path / "masks"
    for folder in (images, masks):
        folder.mkdir()
    for index in range(2):
        write_png(images / f"{index}.png", noise(index, (60, 80, 1)))
    with pytest.raises(PhotoError, match=r"masks/0\.png: mask: there is none for 0\.png"):
        calibrate_photos(images, PhotoOptions(masks=masks))
    for index in range(2):
        write_png(masks / f"{index}.png", noise(index, (61, 80, 1)))
    with pytest.raises(PhotoError, match=r"mask: is 80x61, its photograph 80x60"):
        calibrate_photos(images, PhotoOptions(masks=masks))


def test_exif_gives_the_first_focal_length(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[FOCAL_LENGTH_35MM] = 28
    for index in range(2):
        Image.fromarray(noise(index)[..., 0]).save(tmp_path / f"{index}.jpg", exif=exif)
    for photo in find_photographs(tmp_path, "one"):
        assert photo.exif_focal == pytest.approx(28 / 36 * WIDTH, rel=0.05)


def test_deep_and_colour_photographs_are_staged_as_eight_bit_grey(tmp_path):
    grey = noise(0, (40, 50, 1))
    write_png(tmp_path / "deep.png", grey.astype(np.uint16) * 257)
    write_png(tmp_path / "colour.png", np.repeat(grey, 3, axis=2))
    staged = tmp_path / "staged"
    staged.mkdir()
    names = stage(find_photographs(tmp_path, "one"), None, staged, 1)
    for name in names:
        assert np.array_equal(read_image(staged / "images" / name), grey)
