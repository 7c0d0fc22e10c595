# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection of equirectangular images against closed forms and brute-force integration; files good and bad."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from prt_addon.basis.spherical_harmonics import evaluate, zonal_cosine
from prt_addon.errors import PRTError
from prt_addon.lighting import environment as env


def solid_angle(row: int, height: int, width: int) -> float:
    return 2 * math.pi / width * (math.cos(math.pi * row / height) - math.cos(math.pi * (row + 1) / height))


@pytest.mark.parametrize("size", [(1, 1), (2, 4), (3, 7), (16, 32), (256, 512)])
@pytest.mark.parametrize("order", [1, 5, 10])
def test_white_environment_is_exact_and_lights_diffuse_with_one(size: tuple[int, int], order: int) -> None:
    coefficients = env.project(np.ones((*size, 3), np.float32), order)
    expected = np.zeros((order * order, 3))
    expected[0] = math.sqrt(4 * math.pi)
    np.testing.assert_allclose(coefficients, expected, atol=1e-12)
    normals = np.array([[0, 0, 1.0], [0.6, 0, -0.8]])
    transfer = evaluate(order, normals) * np.repeat(zonal_cosine(order), 2 * np.arange(order) + 1)
    np.testing.assert_allclose(transfer @ coefficients, 1, atol=1e-12)


def brute_force(image: np.ndarray, order: int, samples: int) -> np.ndarray:
    """Midpoint sums over a fine grid inside each pixel."""
    height, width = image.shape[:2]
    fine = np.repeat(np.repeat(image, samples, axis=0), samples, axis=1)
    rows, columns = np.mgrid[:height * samples, :width * samples]
    directions = env.direction_of_pixel(rows, columns, height * samples, width * samples).reshape(-1, 3)
    weights = np.array([solid_angle(r, height * samples, width * samples) for r in range(height * samples)])
    weights = np.repeat(weights, width * samples)
    return evaluate(order, directions).T @ (weights[:, None] * fine.reshape(-1, 3))


def test_projection_equals_brute_force_integration() -> None:
    image = np.random.default_rng(0).uniform(0, 3, (6, 9, 3))
    exact = env.project(image, 10)
    errors = [np.abs(brute_force(image, 10, samples) - exact).max() for samples in (16, 64)]
    assert errors[1] < 2e-4 and errors[1] < errors[0] / 12  # midpoint sums converge to it with the square


@pytest.mark.parametrize(("row", "column"), [(0, 0), (7, 30), (8, 5), (15, 31)])
def test_one_bright_pixel_keeps_all_its_energy(row: int, column: int) -> None:
    height, width, radiance = 16, 32, np.array([1e5, 2e5, 3e5])
    image = np.zeros((height, width, 3), np.float32)
    image[row, column] = radiance
    coefficients = env.project(image, 10)
    flux = radiance * solid_angle(row, height, width)
    np.testing.assert_allclose(coefficients[0] * math.sqrt(4 * math.pi), flux, rtol=1e-12)
    # The pixel's centre of light lies in its direction: band 1 is sqrt(3 / 4 pi) times the integral of (y, z, x).
    toward = env.direction_of_pixel(row, column, height, width)
    centre = coefficients[[3, 1, 2], 0]
    assert centre @ toward / np.linalg.norm(centre) > 0.999


def test_a_tiny_sun_in_a_large_image_is_not_missed() -> None:
    image = np.zeros((512, 1024, 3), np.float32)
    image[200, 700] = 6e4
    coefficients = env.project(image, 10)
    toward = env.direction_of_pixel(200, 700, 512, 1024)
    point = evaluate(10, toward[None])[0] * 6e4 * solid_angle(200, 512, 1024)
    np.testing.assert_allclose(coefficients[:, 1], point, rtol=1e-3, atol=1e-4 * np.abs(point).max())


def test_projection_recovers_a_band_limited_light() -> None:
    wanted = np.random.default_rng(1).normal(size=(36, 3))
    rows, columns = np.mgrid[:512, :1024]
    directions = env.direction_of_pixel(rows, columns, 512, 1024).reshape(-1, 3)
    image = (evaluate(6, directions) @ wanted).reshape(512, 1024, 3)
    np.testing.assert_allclose(env.project(image, 6), wanted, atol=2e-4)


def test_pixels_and_directions_are_inverse_and_the_convention_holds() -> None:
    rows, columns = np.mgrid[:12, :25]
    directions = env.direction_of_pixel(rows, columns, 12, 25)
    found = env.pixel_of_direction(3 * directions, 12, 25)
    np.testing.assert_array_equal(found[0], rows)
    np.testing.assert_array_equal(found[1], columns)
    # The middle of the picture is +X, a quarter of the width to its left +Y, above it +Z.
    np.testing.assert_allclose(env.direction_of_pixel(15.5, 31.5, 32, 64), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(env.direction_of_pixel(15.5, 15.5, 32, 64), [0, 1, 0], atol=1e-15)
    assert env.direction_of_pixel(0, 3, 32, 64)[2] > 0.99
    assert env.pixel_of_direction(np.array([0, 0, -1.0]), 32, 64)[0] == 31
    assert env.pixel_of_direction(np.array([-1.0, -0.0, 0]), 32, 64)[1] == 0


def test_rotation_of_the_world_shifts_the_image() -> None:
    """Turning by whole pixels about Z equals rolling the image: light from +Y comes from +X after 90 degrees."""
    image = np.random.default_rng(2).uniform(size=(16, 32, 3))
    turned = env.project(image, 8, env.world_rotation(90))
    rolled = env.project(np.roll(image, 8, axis=1), 8)
    np.testing.assert_allclose(turned, rolled, atol=1e-12)
    np.testing.assert_allclose(env.world_rotation(90) @ [0, 1, 0], [1, 0, 0], atol=1e-15)


def test_truncation_is_the_energy_left_out() -> None:
    assert env.truncation(np.ones((8, 16, 3)), env.project(np.ones((8, 16, 3)), 3)) == pytest.approx(0, abs=1e-13)
    assert env.truncation(np.zeros((8, 16, 3)), np.zeros((9, 3))) == 0
    # Light from the upper half alone: bands 0 and 1 hold 1/4 and 3/16 of the 4 pi, of an energy of 2 pi.
    half = np.zeros((32, 4, 3))
    half[:16] = 1
    assert env.truncation(half, env.project(half, 1)) == pytest.approx(1 / 2, abs=1e-12)
    assert env.truncation(half, env.project(half, 2)) == pytest.approx(1 / 2 - 3 / 8, abs=1e-12)


def test_truncation_equals_the_measured_error_and_ignores_rotation() -> None:
    image = np.random.default_rng(3).uniform(size=(8, 16, 3)) ** 4
    coefficients = env.project(image, 6)
    rows, columns = np.mgrid[:320, :640]
    directions = env.direction_of_pixel(rows, columns, 320, 640).reshape(-1, 3)
    weights = np.repeat([solid_angle(r, 320, 640) for r in range(320)], 640)[:, None]
    fine = np.repeat(np.repeat(image, 40, axis=0), 40, axis=1).reshape(-1, 3)
    error = (weights * (evaluate(6, directions) @ coefficients - fine) ** 2).sum() / (weights * fine**2).sum()
    assert env.truncation(image, coefficients) == pytest.approx(error, rel=1e-3)
    turned = env.project(image, 6, env.world_rotation(33))
    assert env.truncation(image, turned) == pytest.approx(env.truncation(image, coefficients), abs=1e-12)


def test_energy_by_band_adds_up_and_a_single_pixel_is_honest() -> None:
    image = np.zeros((64, 128, 3))
    image[20, 30] = 1
    energies = env.energy_by_band(image, 10)
    assert energies.shape == (10,)
    lost = env.truncation(image, env.project(image, 10))
    assert 1 - energies.sum() / env.total_energy(image) == pytest.approx(lost, abs=1e-12)
    # A small light of solid angle w: order n holds n^2 w / 4 pi of its energy, so nearly all is left out.
    assert 1 - lost == pytest.approx(100 * solid_angle(20, 64, 128) / (4 * math.pi), rel=0.1)


def test_wrong_shapes_are_refused() -> None:
    for shape in ((4, 8), (4, 8, 4), (0, 8, 3)):
        with pytest.raises(ValueError, match="height, width, 3"):
            env.project(np.zeros(shape), 3)


# Files

def write_exr(path: Path, channels: dict, header: dict | None = None) -> Path:
    with OpenEXR.File(header or {}, channels) as file:
        file.write(str(path))
    return path


def random_image(height: int = 5, width: int = 9) -> np.ndarray:
    return np.random.default_rng(4).uniform(0, 100, (height, width, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_openexr_is_read_top_row_first(tmp_path: Path, kind: type) -> None:
    image = random_image()
    path = write_exr(tmp_path / "sky.exr", {"RGB": image.astype(kind)})
    loaded = env.load_equirectangular(path)
    assert loaded.dtype == np.float32
    np.testing.assert_array_equal(loaded, image.astype(kind))


def test_openexr_layers_alpha_and_grey(tmp_path: Path) -> None:
    image = random_image()
    planes = {"R": image[..., 0].copy(), "G": image[..., 1].copy(), "B": image[..., 2].copy()}
    layer = write_exr(tmp_path / "layer.exr", {f"View.Combined.{k}": v for k, v in planes.items()})
    np.testing.assert_array_equal(env.load_equirectangular(layer), image)
    alpha = write_exr(tmp_path / "alpha.exr", {**planes, "A": np.zeros_like(planes["R"]), "Z": planes["G"]})
    np.testing.assert_array_equal(env.load_equirectangular(alpha), image)
    grey = write_exr(tmp_path / "grey.exr", {"Y": planes["R"]})
    np.testing.assert_array_equal(env.load_equirectangular(grey), image[..., :1].repeat(3, axis=2))
    depth = write_exr(tmp_path / "depth.exr", {"Z": planes["R"]})
    with pytest.raises(PRTError, match=r"depth\.exr: it has no red, green and blue channels \(only Z\)"):
        env.load_equirectangular(depth)


def test_openexr_data_window_is_placed_in_the_frame(tmp_path: Path) -> None:
    image = random_image(2, 3)
    header = {"dataWindow": (np.array([1, 2], np.int32), np.array([3, 3], np.int32)),
              "displayWindow": (np.array([0, 0], np.int32), np.array([7, 3], np.int32))}
    loaded = env.load_equirectangular(write_exr(tmp_path / "crop.exr", {"RGB": image}, header))
    expected = np.zeros((4, 8, 3), np.float32)
    expected[2:4, 1:4] = image
    np.testing.assert_array_equal(loaded, expected)


def rgbe(image: np.ndarray) -> np.ndarray:
    """Ward's encoding: the largest channel sets the exponent."""
    mantissa, exponent = np.frexp(image.max(axis=2))
    scale = np.where(image.max(axis=2) > 1e-32, mantissa * 256 / np.maximum(image.max(axis=2), 1e-32), 0)
    colours = (image * scale[..., None]).astype(np.uint8)
    return np.concatenate([colours, np.where(scale > 0, exponent + 128, 0).astype(np.uint8)[..., None]], axis=2)


def write_hdr(path: Path, pixels: np.ndarray, encoded: bool) -> Path:
    height, width = pixels.shape[:2]
    head = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode()
    body = b""
    for row in pixels:
        if not encoded:
            body += row.tobytes()
            continue
        body += struct.pack(">BBH", 2, 2, width)
        for channel in row.T:
            start = 0
            while start < width:
                run = 1
                while start + run < width and run < 127 and channel[start + run] == channel[start]:
                    run += 1
                body += bytes([128 + run, channel[start]]) if run > 1 else bytes([1, channel[start]])
                start += run
    path.write_bytes(head + body)
    return path


@pytest.mark.parametrize("encoded", [False, True])
def test_radiance_pictures_are_read(tmp_path: Path, encoded: bool) -> None:
    image = random_image(6, 40)
    image[2] = [0.25, 3.0, 7.5]  # a run
    image[3, 5] = 0
    loaded = env.load_equirectangular(write_hdr(tmp_path / "sky.hdr", rgbe(image), encoded))
    assert np.abs(loaded - image).max() <= image.max() / 128
    np.testing.assert_array_equal(loaded[2, 0], [0.25, 3.0, 7.5])  # exact in RGBE
    np.testing.assert_array_equal(loaded[3, 5], 0)


def test_bad_files_are_named_with_their_cause(tmp_path: Path) -> None:
    good = write_exr(tmp_path / "good.exr", {"RGB": random_image(64, 128)})
    hdr = write_hdr(tmp_path / "good.hdr", rgbe(random_image(6, 40)), True)
    cases = {"missing.exr": None, "text.exr": b"hello " * 50, "cut.exr": good.read_bytes()[:2000], "empty.hdr": b"",
             "cut.hdr": hdr.read_bytes()[:-30], "text.hdr": b"#?RADIANCE\nhello\n", "photo.png": b"\x89PNG"}
    for name, content in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(PRTError, match=name.replace(".", r"\.")):
            env.load_equirectangular(path)
    with pytest.raises(PRTError, match="no file"):
        env.load_equirectangular(tmp_path)


def test_pixels_that_are_not_finite_are_counted_and_named(tmp_path: Path) -> None:
    image = random_image()
    image[3, 7, 1] = np.inf
    image[4, 2] = np.nan
    path = write_exr(tmp_path / "broken.exr", {"RGB": image})
    with pytest.raises(PRTError, match=r"broken\.exr: 2 of its pixels .* column 7, row 3"):
        env.load_equirectangular(path)
