"""Markers of one camera from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.lenses import check_size, project, undistort
from ipsys_log.geometry.markers import marker_corners
from ipsys_log.geometry.square_pose import goes_around, solve_squares
from ipsys_log.images.decode import Grey, decode_rows
from ipsys_log.messages import CameraCalibration, CompressedImage, RawImage
from ipsys_log.stages.detect.changes import Watch
from ipsys_log.stages.detect.edges import Fit, Guess, fit_edges
from ipsys_log.stages.detect.motion import LONG_S, Track, extend, predict, same_speed
from ipsys_log.stages.detect.partial import Rejection, fit_partly, resembles
from ipsys_log.stages.detect.search import (
    WHOLE,
    Candidate,
    sample,
    search,
    search_leftovers,
    search_thoroughly,
)
from ipsys_log.units import NS_PER_S

__all__ = ["Follow"]

Array = NDArray[np.float64]

# The whole picture is searched every so many frames, whatever happens, and more thoroughly, at full size,
# every so many.
_SEARCH_EVERY = 20
_THOROUGH_EVERY = 240
# Of one camera so many frames later than of the one before.
_STAGGER = 3
# And decoded as a whole every so many; the others only as far as markers are expected.
_WHOLE_EVERY = 10
_MARGIN_PX = 24
# Times the spread of edges about a fit with one more freedom.
_AS_GOOD = 1.1
# Of two fits of one id, nearer together than this, one is enough.
_SAME_PX = 8.0
# Further from where it was expected, a marker is looked at once more, in the whole frame.
_JUMP_PX = 3.0
# Edges are that near to those of a fit whose pose is the right one of two.
_SURE_PX = 0.08
# Small markers, found only by a thorough search, look nearly the same in both poses.
_MUCH_BETTER = 0.9
# In uneven light, a fit with a larger spread of edges may have an error of that size.
_DISTURBED_PX = 0.5
# From so many frames with markers it is known how blurred edges are.
_BLURS = 10


class Follow:
    """Finds the markers of one camera in frame after frame, starting from where it found them before.

    Parameters
    ----------
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : of the camera.
    edge_offset_px, row_time_s : as for :func:`fit_edges`.
    number : of the camera in the rig. Cameras search the whole picture in different frames: the thorough
        searches of all of them at once would take longer than live tracking has.
    camera : its name, for messages.
    """

    def __init__(
        self,
        dictionary: str,
        lens: CameraCalibration,
        edge_offset_px: float | None,
        row_time_s: float,
        number: int = 0,
        camera: str | None = None,
    ) -> None:
        self._dictionary = dictionary
        self._lens, self._camera = lens, camera
        self._edge_offset_px = edge_offset_px
        self._row_time_s = row_time_s
        self._watch = Watch()
        self._changed: tuple[slice, slice] | None = None
        self._breadth_px = 0.0
        self._frames = -_STAGGER * number
        self._last_ns: int | None = None
        self._blurs_px: list[float] = []
        self._tracks: list[Track] = []
        self._rejections: list[Rejection] = []

    @property
    def rejections(self) -> list[Rejection]:
        """Markers that are seen in the last frame and cannot be measured, sorted by id."""
        fitted = {track[0].pose.id for track in self._tracks}
        last = {one.id: one for one in self._rejections if one.id not in fitted}
        return [last[n] for n in sorted(last)]

    def __call__(self, frame: CompressedImage | RawImage, time_ns: int) -> tuple[list[Fit], int, int]:
        """Return the markers in a frame, sorted by id, and its width and height; an id can occur twice.

        A frame that raises an error changes nothing for those after it.

        Parameters
        ----------
        frame : as recorded.
        time_ns : when it was taken.

        Raises
        ------
        FrameError
            Where it cannot be decoded.
        SizeError
            Where it is of another size than the lens.
        """
        turn = self._frames
        fresh = self._last_ns is None or not 0 < (time_ns - self._last_ns) / NS_PER_S < LONG_S
        due = turn % _SEARCH_EVERY == 0 or fresh
        self._rejections = []
        grey, rows, seen, lost = self._look_again(frame, time_ns, due or turn % _WHOLE_EVERY == 0)
        # One that cannot be decoded is not looked at: its turn is the next one's.
        self._frames, self._last_ns = turn + 1, time_ns
        fits = list(seen.values())
        self._changed = self._watch.changed(grey, rows, [fit.corners_px for fit in fits], self._breadth_px)
        region = WHOLE if lost or due else self._changed
        samples = sample(grey) if fresh else None
        if region is not None:
            fits = self._add(grey, fits, search(grey, self._dictionary, region, samples))
        if samples is not None:
            # Nothing is known yet, and no later frame may show the markers that are missed now.
            known_px = [fit.corners_px for fit in fits]
            leftovers = search_leftovers(grey, self._dictionary, samples, known_px)
            fits = self._add(grey, fits, leftovers, _MUCH_BETTER)
        if turn % _THOROUGH_EVERY == _SEARCH_EVERY or lost - {fit.pose.id for fit in fits}:
            fits = self._add(grey, fits, search_thoroughly(grey, self._dictionary))
        elif turn % _SEARCH_EVERY == _SEARCH_EVERY // 2 and self._changed and len(fits) == len(seen):
            # What is new and no marker at first sight may be one in shadow.
            fits = self._add(grey, fits, search_thoroughly(grey, self._dictionary, self._changed))
        self._watch.forget([fit.corners_px for fit in fits])
        self._remember(list(seen), fits, time_ns)
        return sorted(fits, key=lambda fit: fit.pose.id), grey.shape[1], grey.shape[0]

    def _look_again(
        self, frame: CompressedImage | RawImage, time_ns: int, whole: bool
    ) -> tuple[Grey, list[slice], dict[int, Fit], set[int]]:
        """Follow the markers of the last frame.

        Returns
        -------
        The picture and its decoded rows, the fits by the number of their track, and the ids of markers that
        are not at their predicted position; if there are any, the picture is decoded as a whole.
        """
        guesses = [predict(track, time_ns) for track in self._tracks]
        outlines_px = self._outlines(guesses)
        grey, rows = decode_rows(frame, None if whole else _rows(outlines_px, self._changed))
        check_size(self._lens, grey.shape[1], grey.shape[0], self._camera)
        tried = self._with_speed(grey, time_ns, guesses, self._fit(grey, guesses))
        tried = self._partly(grey, [[guess] for guess in guesses], tried, near=True)
        if rows != [slice(0, len(grey))] and _jumped(outlines_px, tried):
            # Damage in a JPEG moves what comes after it, and is noticed only at its end.
            grey, rows = decode_rows(frame)
            tried = self._with_speed(grey, time_ns, guesses, self._fit(grey, guesses))
            tried = self._partly(grey, [[guess] for guess in guesses], tried, near=True)
        seen = {n: fit for n, fit in enumerate(tried) if fit is not None}
        lost = {
            guess.id
            for n, (guess, outline_px) in enumerate(zip(guesses, outlines_px, strict=True))
            if n not in seen and _inside(outline_px, grey)
        }
        if lost and rows != [slice(0, len(grey))]:
            grey, rows = decode_rows(frame)
        return grey, rows, seen, lost

    def _fit(self, grey: Grey, guesses: Sequence[Guess]) -> list[Fit | None]:
        fits = self._fit_as_guessed(grey, guesses)
        unknown = [n for n, guess in enumerate(guesses) if guess.motion is None]
        if not self._row_time_s or not unknown:
            return fits
        # Shear and tilt look much alike: what can be at rest is taken to be.
        resting = self._fit_as_guessed(grey, [guesses[n]._replace(motion=np.zeros(3)) for n in unknown])
        for n, still in zip(unknown, resting, strict=True):
            moving = fits[n]
            if still is not None and (moving is None or still.spread_px < _AS_GOOD * moving.spread_px):
                fits[n] = still
        return fits

    def _fit_as_guessed(self, grey: Grey, guesses: Sequence[Guess]) -> list[Fit | None]:
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

    def _partly(
        self,
        grey: Grey,
        guesses: Sequence[Sequence[Guess]],
        fits: Sequence[Fit | None],
        near: bool = False,
    ) -> list[Fit | None]:
        """Return the fits; those of markers in uneven light are replaced by fits to their visible edges."""
        better = list(fits)
        for n, (poses, fit) in enumerate(zip(guesses, fits, strict=True)):
            if fit is not None and not fit.uneven:
                continue
            if not all(_inside(outline_px, grey) for outline_px in self._outlines(poses)):
                continue
            if fit is None and not resembles(grey, self._lens, self._dictionary, poses):
                continue
            part = fit_partly(
                grey,
                poses,
                self._dictionary,
                self._lens,
                self._edge_offset_px,
                self._row_time_s,
                self._known_blur_px(),
                near,
            )
            if isinstance(part, Fit):
                better[n] = part
            elif fit is not None and (fit.spread_px > _DISTURBED_PX or fit.pose.blurred.any()):
                better[n] = None
            if isinstance(part, Rejection) and better[n] is None:
                self._rejections.append(part)
        return better

    def _with_speed(
        self, grey: Grey, frame_ns: int, guesses: Sequence[Guess], fits: list[Fit | None]
    ) -> list[Fit | None]:
        """Return the same fits, with the speeds that follow from them if rows take time."""
        if not self._row_time_s:
            return fits
        again = {}
        for n, (guess, fit) in enumerate(zip(guesses, fits, strict=True)):
            if fit is not None:
                known = predict(extend(self._tracks[n], fit, frame_ns, self._row_time_s), frame_ns)
                if not same_speed(known.motion, guess.motion):
                    again[n] = known
        better = dict(zip(again, self._fit(grey, list(again.values())), strict=True))
        return [better.get(n) or fit for n, fit in enumerate(fits)]

    def _add(
        self, grey: Grey, fits: list[Fit], candidates: Iterable[Candidate], better: float = 1.0
    ) -> list[Fit]:
        """Return fits, and those of the candidates that are not among them.

        If two poses look alike, the upright one is selected, unless the spread of the edges about the other
        is less than ``better`` times its own.
        """
        new = [one for one in candidates if not _among(one.id, one.corners_px, fits)]
        if not new:
            return fits
        upright, other = self._guess(new)
        found = self._fit(grey, upright)
        # Where a marker lies as robots carry it, there is no need to try the pose that looks like it.
        unsure = [n for n, fit in enumerate(found) if fit is None or fit.spread_px > _SURE_PX]
        for n, fit in zip(unsure, self._fit(grey, [other[n] for n in unsure]), strict=True):
            one = found[n]
            if fit is not None and (one is None or fit.spread_px < better * one.spread_px):
                found[n] = fit
        found = self._partly(grey, list(zip(upright, other, strict=True)), found)
        fits = list(fits)
        for fit in found:
            if fit is not None and not _among(fit.pose.id, fit.corners_px, fits):
                fits.append(fit)
        return fits

    def _guess(self, candidates: Sequence[Candidate]) -> tuple[list[Guess], list[Guess]]:
        """Both poses of squares that look alike, first those that face the plane of the image."""
        if not candidates:
            return [], []
        corners_px = np.array([one.corners_px for one in candidates])
        uv = undistort(corners_px.reshape(-1, 2), self._lens).reshape(-1, 4, 2)
        usable = [n for n, corners in enumerate(uv) if np.isfinite(corners).all() and goes_around(corners)]
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
        """Corners in px, (4, 2) each; far outside where a guess has gone behind the camera."""
        if not guesses:
            return []
        points = np.array([marker_corners(1.0) @ guess.rotation.T + guess.centre for guess in guesses])
        ahead = points[:, :, 2].min(axis=1) > 0
        points[~ahead] = [0.0, 0.0, 1.0]
        px = project(points.reshape(-1, 3), self._lens).reshape(-1, 4, 2)
        px[~ahead] = -1e6
        return [*px]

    def _remember(self, followed: Sequence[int], fits: Sequence[Fit], frame_ns: int) -> None:
        """``fits`` are first those of the tracks that were followed, in their order, then new ones."""
        # A marker that was lost and found again in the same frame is the one of before.
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


def _among(marker_id: int, corners_px: Array, fits: Iterable[Fit]) -> bool:
    return any(
        fit.pose.id == marker_id and np.abs(fit.corners_px - corners_px).max() < _SAME_PX for fit in fits
    )


def _jumped(outlines_px: Sequence[Array], fits: Sequence[Fit | None]) -> bool:
    return any(
        fit is not None and np.abs(fit.corners_px - outline_px).max() > _JUMP_PX
        for outline_px, fit in zip(outlines_px, fits, strict=True)
    )


def _rows(outlines_px: Sequence[Array], changed: tuple[slice, slice] | None) -> list[slice]:
    """The rows that markers are expected in, with what is needed around them, and those that have changed."""
    rows = [
        slice(max(int(px[:, 1].min()) - _MARGIN_PX, 0), max(int(px[:, 1].max()) + _MARGIN_PX, 0))
        for px in outlines_px
    ]
    return rows if changed is None else [*rows, changed[0]]


def _inside(outline_px: Array, grey: Grey) -> bool:
    height, width = grey.shape
    return bool(((outline_px > 0) & (outline_px < [width - 1, height - 1])).all())
