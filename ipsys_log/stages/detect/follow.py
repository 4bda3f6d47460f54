"""Tracking of the markers of one camera from frame to frame."""

from collections.abc import Iterable, Sequence
from math import inf

import numpy as np

from ipsys_log.messages import Array, CameraCalibration, CompressedImage, Grey, RawImage
from ipsys_log.stages.detect.adjustment import Guess, MarkerFit
from ipsys_log.stages.detect.cells import Candidate
from ipsys_log.stages.detect.edges import fit_edges
from ipsys_log.stages.detect.misprints import Inspection, Misprints
from ipsys_log.stages.detect.motion import LONG_S, ChangeDetector, Track, extend, predict, same_speed
from ipsys_log.stages.detect.partial import Rejection, fit_visible_edges, resembles
from ipsys_log.stages.detect.search import (
    WHOLE,
    Area,
    Ids,
    find_unexplained_areas,
    sample,
    search,
    search_squares,
    search_thoroughly,
    split,
    take,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_rows
from ipsys_log.vision.lenses import check_size, project, undistort
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.square_pose import is_convex, solve_squares

# Number of frames between two searches of the whole image, and between two thorough searches at full size.
_SEARCH_EVERY = 20
_THOROUGH_EVERY = 240
# The searches of each camera start this number of frames after those of the previous camera.
_STAGGER = 3
# Number of frames between two decodings of the whole image. In other frames only the rows with expected
# markers are decoded.
_WHOLE_EVERY = 10
_MARGIN_PX = 24
# A fit at rest is good if its spread of edges is below this multiple of the spread of a moving fit. The
# moving fit has one more freedom.
_AS_GOOD = 1.1
# Two fits of one id are the same marker if they are nearer together.
_SAME_PX = 8.0
# A marker farther from its expected position is fitted again, in the whole frame.
_JUMP_PX = 3.0
# Largest spread of edges of a fit that has certainly the correct one of two poses.
_SURE_PX = 0.08
# Small markers, detected only by a thorough search, look nearly the same in both poses.
_MUCH_BETTER = 0.9
# In uneven light, a fit with a larger spread of edges may have an error of that size.
_DISTURBED_PX = 0.5
# Number of frames with markers that determine the blur of edges.
_BLURS = 10


class MarkerTracker:
    """A tracker of the markers of one camera, which starts each frame from the poses of earlier frames.

    Parameters
    ----------
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : intrinsics of the camera.
    edge_offset_px, row_time_s : as for :func:`fit_edges`.
    number : number of the camera in the rig. Cameras search the whole image in different frames.
        Simultaneous thorough searches of all cameras would take too long for live tracking.
    camera : its name, for messages.
    is_thorough : search the first frame thoroughly, too. After a reset, no earlier frame shows the markers
        that only this search finds.
    ids : the ids in use. Markers of other ids are only detected if their cells are clear. None: all ids.
    """

    def __init__(
        self,
        dictionary: str,
        lens: CameraCalibration,
        edge_offset_px: float | None,
        row_time_s: float,
        number: int = 0,
        camera: str | None = None,
        is_thorough: bool = False,
        ids: Ids = None,
    ) -> None:
        self._dictionary = dictionary
        self._is_thorough, self._ids = is_thorough, ids
        self._lens, self._camera = lens, camera
        self._edge_offset_px = edge_offset_px
        self._row_time_s = row_time_s
        self._watch = ChangeDetector()
        self._changed: tuple[slice, slice] | None = None
        self._breadth_px = 0.0
        self._frames = -_STAGGER * number
        self._last_ns: int | None = None
        self._blurs_px: list[float] = []
        self._tracks: list[Track] = []
        self._rejections: list[Rejection] = []
        self._candidates: list[Candidate] = []
        self._inspect = Inspection()
        # The areas that the next frames search thoroughly.
        self._areas: list[Area] = []
        # The prints in the last frame that are no markers of the rig, if it was inspected.
        self.misprints: Misprints | None = None

    @property
    def squares(self) -> list[Candidate]:
        """Return the new markers of the last frame, measured or rejected, or not square, with raw corners."""
        ids = {track[0].pose.id for track in self._tracks} | {rejection.id for rejection in self._rejections}
        return [
            candidate
            for candidate in self._candidates
            if candidate.id in ids or not _is_square(undistort(candidate.corners_px, self._lens))
        ]

    @property
    def rejections(self) -> list[Rejection]:
        """Return the markers that are visible in the last frame but cannot be measured, sorted by id."""
        fitted = {track[0].pose.id for track in self._tracks}
        last = {rejection.id: rejection for rejection in self._rejections if rejection.id not in fitted}
        return [last[n] for n in sorted(last)]

    def __call__(self, frame: CompressedImage | RawImage, time_ns: int) -> tuple[list[MarkerFit], int, int]:
        """Return the markers in a frame, sorted by id, and its width and height; an id can occur twice.

        A frame that raises an error does not affect the frames after it.

        Parameters
        ----------
        frame : as recorded.
        time_ns : capture time of the frame.

        Raises
        ------
        FrameError
            The frame cannot be decoded.
        SizeError
            The size of the frame differs from the size in the camera calibration.
        """
        turn = self._frames
        fresh = self._last_ns is None or not 0 < (time_ns - self._last_ns) / NS_PER_S < LONG_S
        due = turn % _SEARCH_EVERY == 0 or fresh
        thorough = turn % _THOROUGH_EVERY == _SEARCH_EVERY or (self._is_thorough and self._last_ns is None)
        self._rejections, self._candidates = [], []
        whole = due or turn % _WHOLE_EVERY == 0 or bool(self._areas)
        grey, rows, seen, lost = self._look_again(frame, time_ns, whole)
        # A frame that cannot be decoded raises an error before this line: the next frame takes its turn.
        self._frames, self._last_ns = turn + 1, time_ns
        fits = list(seen.values())
        self._changed = self._watch.find_change(
            grey, rows, [fit.corners_px for fit in fits], self._breadth_px
        )
        region = WHOLE if lost or due else self._changed
        samples, squares_px = sample(grey) if fresh else None, None
        if region is not None:
            if region is WHOLE:
                candidates, squares_px = search_squares(grey, self._dictionary, samples, self._ids)
            else:
                candidates = search(grey, self._dictionary, region, self._ids)
            fits = self._add(grey, fits, candidates)
        mask, better = None, 1.0
        if samples is not None:
            # No marker is known yet, and later frames may not show the markers that are missed now.
            known_px = [fit.corners_px for fit in fits]
            self._areas, mask = find_unexplained_areas(grey, samples, known_px, is_whole=thorough)
            better = _MUCH_BETTER
        elif thorough or lost - {fit.pose.id for fit in fits}:
            self._areas += [area for area in split(grey.shape) if area not in self._areas]
        elif turn % _SEARCH_EVERY == _SEARCH_EVERY // 2 and self._changed and len(fits) == len(seen):
            # A new object without a detected marker may be a marker in shadow.
            self._areas += split(grey.shape, self._changed)
        candidates = []
        for area in take(self._areas):
            candidates += search_thoroughly(grey, self._dictionary, area, self._ids, mask, is_faint=thorough)
        fits = self._add(grey, fits, candidates, better)
        self.misprints = None
        if due or self._rejections:
            known_px, odd = [fit.corners_px for fit in fits], bool(self._rejections)
            self.misprints = self._inspect(grey, self._dictionary, known_px, squares_px, has_rejections=odd)
        self._watch.forget([fit.corners_px for fit in fits])
        self._remember(list(seen), fits, time_ns)
        return sorted(fits, key=lambda fit: fit.pose.id), grey.shape[1], grey.shape[0]

    def _look_again(
        self, frame: CompressedImage | RawImage, time_ns: int, whole: bool
    ) -> tuple[Grey, list[slice], dict[int, MarkerFit], set[int]]:
        """Follow the markers of the last frame.

        Returns
        -------
        The image and its decoded rows, the fits by the number of their track, and the ids of markers that
        are not at their predicted position. If there are such markers, the whole image is decoded.
        """
        guesses = [predict(track, time_ns) for track in self._tracks]
        outlines_px = self._outlines(guesses)
        grey, rows = decode_rows(frame, None if whole else _rows(outlines_px, self._changed))
        check_size(self._lens, grey.shape[1], grey.shape[0], self._camera)
        tried = self._with_speed(grey, time_ns, guesses, self._fit(grey, guesses))
        tried = self._fit_disturbed(grey, [[guess] for guess in guesses], tried, near=True)
        if rows != [slice(0, len(grey))] and _jumped(outlines_px, tried):
            # Damage in a JPEG moves the image after it. The decoder notices the damage only at the end.
            grey, rows = decode_rows(frame)
            tried = self._with_speed(grey, time_ns, guesses, self._fit(grey, guesses))
            tried = self._fit_disturbed(grey, [[guess] for guess in guesses], tried, near=True)
        seen = {n: fit for n, fit in enumerate(tried) if fit is not None}
        lost = {
            guess.id
            for n, (guess, outline_px) in enumerate(zip(guesses, outlines_px, strict=True))
            if n not in seen and _inside(outline_px, grey)
        }
        if lost and rows != [slice(0, len(grey))]:
            grey, rows = decode_rows(frame)
        return grey, rows, seen, lost

    def _fit(self, grey: Grey, guesses: Sequence[Guess]) -> list[MarkerFit | None]:
        fits = self._fit_as_guessed(grey, guesses)
        unknown = [n for n, guess in enumerate(guesses) if guess.motion is None]
        if not self._row_time_s or not unknown:
            return fits
        # Shear and tilt look nearly the same: a marker that can be at rest is assumed to be at rest.
        resting = self._fit_as_guessed(grey, [guesses[n]._replace(motion=np.zeros(3)) for n in unknown])
        for n, still in zip(unknown, resting, strict=True):
            moving = fits[n]
            if still is not None and (moving is None or still.rms_px < _AS_GOOD * moving.rms_px):
                fits[n] = still
        return fits

    def _fit_as_guessed(self, grey: Grey, guesses: Sequence[Guess]) -> list[MarkerFit | None]:
        return fit_edges(
            grey,
            guesses,
            self._dictionary,
            self._lens,
            self._edge_offset_px,
            self._row_time_s,
            self._known_blur_px(),
        )

    def _known_blur_px(self) -> float | None:
        return float(np.mean(self._blurs_px).round(2)) if len(self._blurs_px) == _BLURS else None

    def _fit_disturbed(
        self,
        grey: Grey,
        guesses: Sequence[Sequence[Guess]],
        fits: Sequence[MarkerFit | None],
        near: bool = False,
    ) -> list[MarkerFit | None]:
        """Return the fits; replace those of markers in uneven light by fits to their visible edges."""
        better = list(fits)
        for n, (poses, fit) in enumerate(zip(guesses, fits, strict=True)):
            if fit is not None and not fit.disturbed:
                continue
            if self._ids is not None and poses[0].id not in self._ids:
                continue  # no position is computed from it
            if not all(_inside(outline_px, grey) for outline_px in self._outlines(poses)):
                continue
            if fit is None and not resembles(grey, self._lens, self._dictionary, poses):
                continue
            part = fit_visible_edges(
                grey,
                poses,
                self._dictionary,
                self._lens,
                self._edge_offset_px,
                self._row_time_s,
                self._known_blur_px(),
                near,
            )
            if isinstance(part, MarkerFit):
                better[n] = part
            elif fit is not None and (fit.rms_px > _DISTURBED_PX or fit.pose.blurred.any()):
                better[n] = None
            if isinstance(part, Rejection) and better[n] is None:
                self._rejections.append(part)
        return better

    def _with_speed(
        self, grey: Grey, frame_ns: int, guesses: Sequence[Guess], fits: list[MarkerFit | None]
    ) -> list[MarkerFit | None]:
        """Return the fits; with a rolling shutter, repeat those whose track gives a new speed."""
        if not self._row_time_s:
            return fits
        predicted = {}
        for n, (guess, fit) in enumerate(zip(guesses, fits, strict=True)):
            if fit is not None:
                prediction = predict(extend(self._tracks[n], fit, frame_ns, self._row_time_s), frame_ns)
                if not same_speed(prediction.motion, guess.motion):
                    predicted[n] = prediction
        better = dict(zip(predicted, self._fit(grey, list(predicted.values())), strict=True))
        return [better.get(n) or fit for n, fit in enumerate(fits)]

    def _add(
        self, grey: Grey, fits: list[MarkerFit], candidates: Iterable[Candidate], better: float = 1.0
    ) -> list[MarkerFit]:
        """Return the fits and those of the candidates that are not among them.

        If two poses look alike, the function selects the upright pose. It selects the other pose if the
        spread of its edges is less than ``better`` times that of the upright pose. A marker can have several
        candidates: the best fits of its id count.
        """
        new_candidates = [one for one in candidates if not _among(one.id, one.corners_px, fits)]
        if not new_candidates:
            return fits
        self._candidates += new_candidates
        upright, other = self._guess(new_candidates)
        new_fits = self._fit(grey, upright)
        # If the upright pose, usual for markers on robots, has a small spread, the other pose is not tried.
        unsure = [n for n, fit in enumerate(new_fits) if fit is None or fit.rms_px > _SURE_PX]
        least_px = {fit.pose.id: fit.rms_px for fit in reversed(_best_first(new_fits))}
        for n, fit in zip(unsure, self._fit(grey, [other[n] for n in unsure]), strict=True):
            if fit is not None and fit.rms_px < better * least_px.get(fit.pose.id, inf):
                new_fits[n] = fit
        new_fits = self._fit_disturbed(grey, list(zip(upright, other, strict=True)), new_fits)
        for fit in _best_first(new_fits):
            if not _among(fit.pose.id, fit.corners_px, fits):
                fits = [*fits, fit]
        return fits

    def _guess(self, candidates: Sequence[Candidate]) -> tuple[list[Guess], list[Guess]]:
        """Return both poses that look alike for each square, first the poses that face the image plane."""
        if not candidates:
            return [], []
        corners_px = np.array([candidate.corners_px for candidate in candidates])
        uv = undistort(corners_px.reshape(-1, 2), self._lens).reshape(-1, 4, 2)
        usable = [n for n, corners in enumerate(uv) if _is_square(corners)]
        if not usable:
            return [], []
        rotations, centres = solve_squares(uv[usable], np.ones(len(usable)))
        order = rotations[:, :, 2, 2].argsort(axis=1, kind="stable")
        upright, other = (
            [
                Guess(candidates[n].id, rotations[k, order[k, i]], centres[k, order[k, i]])
                for k, n in enumerate(usable)
            ]
            for i in (0, 1)
        )
        return upright, other

    def _outlines(self, guesses: Sequence[Guess]) -> list[Array]:
        """Return the corners in px, (4, 2) each; far outside the image if a guess is behind the camera."""
        if not guesses:
            return []
        points = np.array([marker_corners(1.0) @ guess.rotation.T + guess.centre for guess in guesses])
        ahead = points[:, :, 2].min(axis=1) > 0
        points[~ahead] = [0.0, 0.0, 1.0]
        px = project(points.reshape(-1, 3), self._lens).reshape(-1, 4, 2)
        px[~ahead] = -1e6
        return [*px]

    def _remember(self, followed: Sequence[int], fits: Sequence[MarkerFit], frame_ns: int) -> None:
        """Extend the tracks by ``fits``: first the fits of followed tracks, in their order, then new fits."""
        # A marker that is lost and detected again in the same frame continues its old track.
        left = {t[0].pose.id: t for n, t in enumerate(self._tracks) if n not in followed}
        before = [self._tracks[n] for n in followed]
        before += [left.pop(fit.pose.id, ()) for fit in fits[len(followed) :]]
        self._tracks = [
            extend(track, fit, frame_ns, self._row_time_s) for track, fit in zip(before, fits, strict=True)
        ]
        if fits and len(self._blurs_px) < _BLURS:
            self._blurs_px.append(fits[0].blur_px)
        if fits:
            self._breadth_px = max(float(np.ptp(fit.corners_px, axis=0).min()) for fit in fits)


def _best_first(fits: Iterable[MarkerFit | None]) -> list[MarkerFit]:
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: fit.rms_px)


def _among(marker_id: int, corners_px: Array, fits: Iterable[MarkerFit]) -> bool:
    return any(
        fit.pose.id == marker_id and np.abs(fit.corners_px - corners_px).max() < _SAME_PX for fit in fits
    )


def _jumped(outlines_px: Sequence[Array], fits: Sequence[MarkerFit | None]) -> bool:
    return any(
        fit is not None and np.abs(fit.corners_px - outline_px).max() > _JUMP_PX
        for outline_px, fit in zip(outlines_px, fits, strict=True)
    )


def _is_square(uv: Array) -> bool:
    """Return whether corners (4, 2) can be those of a marker seen from in front."""
    return bool(np.isfinite(uv).all()) and is_convex(uv)


def _rows(outlines_px: Sequence[Array], changed: tuple[slice, slice] | None) -> list[slice]:
    """Return the rows with expected markers, with the necessary margin, and the changed rows."""
    rows = [
        slice(max(int(px[:, 1].min()) - _MARGIN_PX, 0), max(int(px[:, 1].max()) + _MARGIN_PX, 0))
        for px in outlines_px
    ]
    return rows if changed is None else [*rows, changed[0]]


def _inside(outline_px: Array, grey: Grey) -> bool:
    height, width = grey.shape
    return bool(((outline_px > 0) & (outline_px < [width - 1, height - 1])).all())
