"""Chooses the lens model of photographs: the simplest one, unless a further parameter improves the fit clearly.

Structure from motion begins with one focal length and one radial term. Few photographs do not determine more: a lens with eight free
parameters then takes up the errors of poses and points, and its values are absurd. Here the models of COLMAP are compared on the points
of a finished model, by the Bayesian information criterion under errors with heavy tails (bivariate Student t). A camera that makes no
sense with any of them is taken out of the model.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens, straightening
from advnerf_core.geometry import Pinhole
from calibration.colmap_lens import lens_of
from calibration.photo_model import MIN_IMAGES, Report

# Name, free parameters, and the fewest images of the camera with which the model is tried at all.
_MODELS = (("SIMPLE_PINHOLE", 1, 1), ("SIMPLE_RADIAL", 2, 1), ("RADIAL", 3, 5), ("OPENCV", 6, 20))
FIRST_MODEL = "SIMPLE_RADIAL"
# Focal length in shares of the longer side. From 17 mm to 290 mm on a 35 mm film: phones, cameras, not fisheyes, not telescopes.
FOCAL_RATIOS = (0.47, 8.0)
_MAX_ASPECT = 0.1
# How far distortion may move a corner, as a share of its distance from the centre. Beyond that only a fisheye model would do.
_MAX_CORNER_SHIFT = 0.5
MAX_FOCAL_ERROR_PERCENT = 5.0
# A difference of 10 counts as very strong evidence (Kass and Raftery 1995).
_EVIDENCE = 10.0
_DEGREES_OF_FREEDOM = 4.0
# Errors of neighbouring features are alike, which the covariance does not know: blur, rolling shutter, the lens's own residuals.
_ALIKE = 3.0
_MAX_REPROJECTION_PX, _MIN_ANGLE_DEG = 4.0, 1.5


@dataclass(frozen=True)
class LensChoice:
    """The chosen lens of one camera.

    Attributes:
        model: COLMAP's name of the model.
        why: Reason for the choice.
        focal_error_percent: Standard error of the focal length [%]; None if it is held, or could not be computed.
    """

    model: str
    why: str
    focal_error_percent: float | None = None


def intrinsics(camera: Any) -> tuple[Pinhole, Lens]:
    """Intrinsics of a COLMAP camera with one of the models above."""
    found = lens_of(camera)
    if found is None:
        raise ValueError(
            f"expected a camera with the model of a pinhole or OpenCV lens, got {camera.model_name}"
        )
    return found


def nonsense(pinhole: Pinhole, lens: Lens) -> str | None:
    """Describe why intrinsics are impossible; None if they are possible."""
    ratio = pinhole.fx / max(pinhole.width, pinhole.height)
    if not FOCAL_RATIOS[0] <= ratio <= FOCAL_RATIOS[1]:
        low, high = FOCAL_RATIOS
        return f"focal length {pinhole.fx:.4g} px is {ratio:.3g} of the longer side, expected {low:g} to {high:g}"
    if abs(pinhole.fy / pinhole.fx - 1.0) > _MAX_ASPECT:
        return f"focal lengths {pinhole.fx:.4g} and {pinhole.fy:.4g} px differ by more than {100 * _MAX_ASPECT:.0f} %"
    corner = math.hypot(0.5 * pinhole.width / pinhole.fx, 0.5 * pinhole.height / pinhole.fy)
    k1, k2 = lens.coefficients[:2]
    radii = np.linspace(0.0, corner, 200)[1:]
    scale = 1.0 + k1 * radii**2 + k2 * radii**4
    coefficients = ", ".join(f"{value:.3g}" for value in lens.coefficients[:4])
    if np.abs(scale - 1.0).max() > _MAX_CORNER_SHIFT:
        return f"distortion {coefficients} moves the corners by more than {100 * _MAX_CORNER_SHIFT:.0f} %"
    if (np.diff(radii * scale) <= 0.0).any():
        return f"distortion {coefficients} folds the border over itself"
    try:
        straightening(pinhole, lens)  # learning a scene does the same
    except DatasetError:
        return f"distortion {coefficients} cannot be undone over the whole image"
    return None


def choose_lenses(
    reconstruction: Any, held: Collection[int], exif_focal_px: Mapping[int, float], report: Report
) -> tuple[dict[int, LensChoice], dict[str, str]]:
    """Choose the lens of every camera that is not held, refine the model with it, and take out cameras that make no sense.

    Args:
        reconstruction: COLMAP's model, with ``FIRST_MODEL`` for cameras that are not held; changed in place.
        held: Cameras whose intrinsics are known.
        exif_focal_px: Focal lengths from the photographs' EXIF data, by camera [px].

    Returns:
        The choice for each remaining camera, and the reason for each image that was removed.
    """
    images = images_of(reconstruction)
    known = {number: LensChoice("OPENCV", "known, held") for number in images if number in held}
    unknown = [number for number in images if number not in held]
    if not unknown:
        return known, {}
    scale_px = typical_error_px(reconstruction)
    chosen = _by_evidence(reconstruction, unknown, held, scale_px, report)
    constant, left_out = set(held), dict[str, str]()
    while chosen and sum(map(len, images_of(reconstruction).values())) >= MIN_IMAGES:
        report(0.8, "bundle adjustment with the chosen lenses")
        for number, choice in chosen.items():
            set_model(reconstruction.cameras[number], choice.model)
        errors = adjust(reconstruction, constant, scale_px, with_errors=True)
        problems = {
            number: why for number in chosen if (why := _problem(reconstruction, number, errors.get(number)))
        }
        if not problems:
            chosen = {
                number: replace(each, focal_error_percent=errors.get(number))
                for number, each in chosen.items()
            }
            break
        distorted = [number for number in problems if chosen[number].model != "SIMPLE_PINHOLE"]
        for number in distorted:
            chosen[number] = LensChoice(
                "SIMPLE_PINHOLE", f"no distortion, because with it the {problems[number]}"
            )
        if distorted:
            continue
        # One at a time: without the worst, the others may do.
        worst = max(problems, key=lambda number: errors.get(number, math.inf))
        if worst in exif_focal_px and worst not in constant:
            chosen[worst] = LensChoice(
                "SIMPLE_PINHOLE", f"EXIF focal length, held, because without it the {problems[worst]}"
            )
            _set_focal_length(reconstruction.cameras[worst], exif_focal_px[worst])
            constant.add(worst)
        else:
            left_out |= _take_out(reconstruction, worst, problems[worst])
            del chosen[worst]
    _filter_points(reconstruction)
    return known | chosen, left_out


def images_of(reconstruction: Any) -> dict[int, list[Any]]:
    """Images that have a pose, by camera, both in order of their numbers."""
    found: dict[int, list[Any]] = {}
    for image in sorted(
        (i for i in reconstruction.images.values() if i.has_pose), key=lambda image: image.image_id
    ):
        found.setdefault(int(image.camera_id), []).append(image)
    return dict(sorted(found.items()))


def _residuals_px(reconstruction: Any) -> dict[int, NDArray[np.float64]]:
    """Distances of all observations from their points' projections [px], by camera."""
    place = {number: point.xyz for number, point in reconstruction.points3D.items()}
    found = {}
    for number, images in images_of(reconstruction).items():
        pinhole, lens = intrinsics(reconstruction.cameras[number])
        parts = []
        for image in images:
            seen = [point for point in image.points2D if point.has_point3D()]
            if not seen:
                continue
            T = image.cam_from_world().matrix()
            inside = np.array([place[point.point3D_id] for point in seen]) @ T[:, :3].T + T[:, 3]
            parts.append(np.linalg.norm(lens.distort(inside, pinhole) - [point.xy for point in seen], axis=1))
        found[number] = np.concatenate(parts) if parts else np.zeros(0)
    return found


def typical_error_px(reconstruction: Any) -> float:
    """Standard deviation of an observation along one axis [px], from the median: outliers do not count."""
    distances = np.concatenate(list(_residuals_px(reconstruction).values()))
    return max(float(np.median(distances)) / math.sqrt(2.0 * math.log(2.0)), 0.05) if len(distances) else 1.0


def _by_evidence(
    reconstruction: Any, unknown: Collection[int], held: Collection[int], scale_px: float, report: Report
) -> dict[int, LensChoice]:
    """The choice of each camera: every model is fitted to a copy, to all cameras with enough images for it at once."""
    images = {number: len(each) for number, each in images_of(reconstruction).items()}
    criteria: dict[int, dict[str, float]] = {number: {} for number in unknown}
    for index, (model, parameters, fewest) in enumerate(_MODELS):
        tried = [number for number in unknown if images[number] >= fewest]
        if not tried:
            continue
        report(0.8 * index / len(_MODELS), f"is {model} the lens?")
        fitted = copy.deepcopy(reconstruction)
        for number in tried:
            set_model(fitted.cameras[number], model)
        adjust(fitted, held, scale_px)
        for number, distances in _residuals_px(fitted).items():
            if number in tried and nonsense(*intrinsics(fitted.cameras[number])) is None:
                criteria[number][model] = _criterion(distances, parameters, scale_px)
    return {number: _simplest(criteria[number], images[number]) for number in unknown}


def _criterion(distances_px: NDArray[np.float64], parameters: int, scale_px: float) -> float:
    """Bayesian information criterion: ``-2 log L + p log n`` with the bivariate Student t likelihood of the distances."""
    nu = _DEGREES_OF_FREEDOM
    likelihood = (nu + 2.0) * float(np.log1p(distances_px**2 / (nu * scale_px**2)).sum())
    return likelihood + parameters * math.log(max(2 * len(distances_px), 1))


def _simplest(criteria: Mapping[str, float], images: int) -> LensChoice:
    """The model that no later one beats by clear evidence."""
    said, best = [], None
    for model, _, fewest in _MODELS:
        if images < fewest:
            said.append(f"{model} needs {fewest} images")
        elif model not in criteria:
            said.append(f"{model} makes no sense")
        elif best is None:
            best = model
        else:
            gain = criteria[best] - criteria[model]
            said.append(f"{model} over {best}: evidence {gain:.0f}")
            best = model if gain > _EVIDENCE else best
    return LensChoice(best or "SIMPLE_PINHOLE", f"{'; '.join(said)} ({_EVIDENCE:.0f} decides)")


def set_model(camera: Any, model: str) -> None:
    """Change a camera's model; parameters of both models are kept."""
    import pycolmap

    if camera.model_name == model:
        return
    pinhole, lens = intrinsics(camera)
    new = pycolmap.Camera.create_from_model_name(
        camera.camera_id, model, pinhole.fx, pinhole.width, pinhole.height
    )
    params = np.array(new.params)
    params[new.focal_length_idxs()] = [pinhole.fx, pinhole.fy][: len(new.focal_length_idxs())]
    params[new.principal_point_idxs()] = [pinhole.cx, pinhole.cy]
    count = len(new.extra_params_idxs())
    if count:
        params[new.extra_params_idxs()] = lens.coefficients[:count]
    camera.model, camera.params = new.model, params


def _set_focal_length(camera: Any, focal_px: float) -> None:
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] = focal_px
    camera.params = params


def adjust(
    reconstruction: Any, constant: Collection[int], scale_px: float, with_errors: bool = False
) -> dict[int, float]:
    """Bundle adjustment, principal points held; if wanted, standard errors of the refined focal lengths [%] by camera."""
    import pycolmap

    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_principal_point, options.print_summary = False, False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = math.sqrt(_DEGREES_OF_FREEDOM) * scale_px
    options.ceres.solver_options.num_threads = 1  # sums over threads in another order end in another model
    images = images_of(reconstruction)
    for number, each in images.items():
        for image in each:
            config.add_image(image.image_id)
        if number in constant:
            config.set_constant_cam_intrinsics(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    adjuster.solve()
    reconstruction.update_point_3d_errors()
    if not with_errors:
        return {}
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), reconstruction, adjuster)
    errors = {}
    for camera in (reconstruction.cameras[number] for number in images if number not in constant):
        of_camera = None if covariance is None else covariance.get_other_params_cov(camera.params)
        if of_camera is not None:
            error_px = _ALIKE * scale_px * math.sqrt(max(float(of_camera[0, 0]), 0.0))
            errors[int(camera.camera_id)] = 100.0 * error_px / float(camera.focal_length_x)
    return errors


def _problem(reconstruction: Any, number: int, focal_error_percent: float | None) -> str | None:
    if (why := nonsense(*intrinsics(reconstruction.cameras[number]))) is not None:
        return why
    if focal_error_percent is not None and focal_error_percent > MAX_FOCAL_ERROR_PERCENT:
        return f"focal length is only known within {focal_error_percent:.3g} % (at most {MAX_FOCAL_ERROR_PERCENT:g} % wanted)"
    return None


def _take_out(reconstruction: Any, number: int, why: str) -> dict[str, str]:
    """Remove the images of a camera; the reason by their names."""
    images = images_of(reconstruction)[number]
    names = {image.name: int(image.frame_id) for image in images}
    for frame in names.values():
        reconstruction.deregister_frame(frame)
    reconstruction.tear_down()  # else the covariance asks for the poses of what was taken out
    return dict.fromkeys(names, why)


def _filter_points(reconstruction: Any) -> None:
    import pycolmap

    pycolmap.ObservationManager(reconstruction).filter_all_points3D(_MAX_REPROJECTION_PX, _MIN_ANGLE_DEG)
    reconstruction.update_point_3d_errors()
