"""Renderer of simulated camera images: background, arm, marker body, lens blur, sensor noise.

The marker body is drawn by area coverage: spans of every dot and plate are found exactly on sixteen lines per pixel
row, so that centroids are exact to a few thousandths of a pixel. (A rasteriser's images are biased by up to half a
pixel, and even antialiased ones by hundredths.) With lens distortion a dot is the exact image of its rim, so that, as
with a real one, its centroid differs from the image of its centre; what is behind the body is distorted as an image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.distortion import distort, undistort
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_sim.world.body import MarkerBody, SolidBody
from stereoservo_sim.world.camera_rig import PinholeCamera, project
from stereoservo_sim.world.coverage import blend_ellipse, blend_polygon
from stereoservo_sim.world.lighting import Lighting
from stereoservo_sim.world.robots import shape_segments
from stereoservo_sim.world.simulated_cell import SimulatedCell

DOT_LEVEL = 225.0
PLATE_LEVEL = 24.0
BACK_LEVEL = 70.0
BAND = 16
"""Rows of a rolling shutter that are exposed at the same time."""
_NOISE_MARGIN = 64
Region = tuple[int, int, int, int]
"""Left, top, right, bottom [px]; right and bottom are exclusive."""
Link = tuple[FloatArray, float, float]
"""A link's outline (k, 2) [px], its grey level, and its least depth [m]."""


@dataclass(frozen=True)
class RenderSettings:
    """Settings of the renderer.

    ``blur_px``: sigma of the lens blur; ``noise_grey``: sigma of the sensor noise [grey levels].
    ``background``: ``pybullet`` is its rendered arm, refreshed now and then; ``arm`` draws a room and the arm again for
    every frame; ``plain`` is a uniform grey. ``lighting``: variation of light; None: constant.
    """

    blur_px: float = 0.7
    noise_grey: float = 2.0
    background: str = "arm"
    lighting: Lighting | None = None


class Renderer:
    """Renders the simulated cell in one camera of its rig. Caches the background and a noise field.

    Raises ValueError if the camera's lens leaves the image's corners dark.
    """

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera, settings: RenderSettings) -> None:
        self.cell = cell
        self.camera = camera
        self.settings = settings
        self._bending = BentImage(camera)
        self._backdrop = _backdrop(cell, self._bending.pinhole, settings.background)
        shape = (camera.height + _NOISE_MARGIN, camera.width + _NOISE_MARGIN)
        field = np.random.default_rng(20010101).standard_normal(shape) * settings.noise_grey
        self._noise = field.astype(np.float32)

    def render(
        self,
        q: FloatArray,
        rng: np.random.Generator,
        workpiece: FloatArray | None = None,
        *,
        focus: float = 1.0,
        at_row: Callable[[float], FloatArray] | None = None,
        t_s: float = 0.0,
    ) -> ImageArray:
        """The image (height, width) with the arm at ``q`` (n,) [rad]; ``rng`` gives this frame's noise.

        ``workpiece`` (4, 4): its pose in the world; default: its initial pose. Links nearer than the workpiece are
        drawn over it if they are nearer than the body, too. ``focus``: focal length for drawing the body as a multiple
        of the camera's.
        ``at_row``: arm position at a row's exposure, in bands of ``BAND`` rows, used in place of ``q``. ``t_s``: time
        since the start of the light variation.
        """
        camera = self.camera.focused(focus)
        if at_row is None:
            return self._expose(self._drawn(q, workpiece, camera), rng, t_s)
        image = np.empty((camera.height, camera.width), dtype=np.float32)
        for top in range(0, camera.height, BAND):
            rows = slice(top, min(top + BAND, camera.height))
            image[rows] = self._drawn(at_row(0.5 * (rows.start + rows.stop - 1)), workpiece, camera)[rows]
        return self._expose(image, rng, t_s)

    def _drawn(self, q: FloatArray, workpiece: FloatArray | None, camera: PinholeCamera) -> npt.NDArray[np.float32]:
        """The image before the sensor's noise."""
        background, front = self._backdrop.image(q), []
        if self.settings.background == "arm":
            background = background.copy()
            front = self._draw_arm(background, q)
        elif self.settings.background == "pybullet":
            front = self._draw_arm(background.copy(), q)  # only parts in front of the body are drawn again
        image = self._bending.image(background).astype(np.float32)
        for region in self._draw_markers(image, q, front, workpiece, camera):
            if self.settings.blur_px > 0:
                _blur(image, region, self.settings.blur_px)
        return image

    def _draw_markers(
        self,
        image: npt.NDArray[np.float32],
        q: FloatArray,
        front: list[Link],
        workpiece: FloatArray | None,
        camera: PinholeCamera,
    ) -> list[Region]:
        """Draw the body, the workpiece and the links in ``front`` of the body, far ones first; returns the disjoint
        regions
        touched.
        """
        layers: list[Callable[[], Region | None]] = [
            lambda: draw_body(image, self.cell, camera, q),
            *(partial(self._draw_link, image, outline, level) for outline, level, _ in front),
        ]
        part = self.cell.workpiece
        if part is not None:
            placed, pose = self.cell.in_world(camera, q), part.stand if workpiece is None else workpiece
            depth = float(project(placed.P, part.marker_positions(pose))[1].min())
            body_depth = float(project(placed.P, self.cell.marker_positions(q))[1].min())
            depths = [body_depth, *(nearest + 0.03 for _, _, nearest in front)]
            place = next((k for k, other in enumerate(depths) if other < depth), len(depths))
            layers.insert(place, lambda: draw_faces(image, part.body, pose, placed))
        return _apart([region for draw in layers if (region := draw()) is not None])

    def _draw_link(self, image: npt.NDArray[np.float32], outline: FloatArray, level: float) -> None:
        blend_polygon(image, self._bending.outline(outline), level)

    def _draw_arm(self, image: ImageArray, q: FloatArray) -> list[Link]:
        """Draw links behind the body; return those in front of it as (outline (k, 2), grey level, depth).

        ``image`` and outlines are those of the pinhole, before the lens bends them.
        """
        ends, radii = shape_segments(self.cell.robot, q)
        camera = self.cell.in_world(self._bending.pinhole, q)
        body_depth = float(project(camera.P, self.cell.marker_positions(q))[1].min())
        links = []
        for i, (segment, radius) in enumerate(zip(ends, radii, strict=True)):
            centres, depths = project(camera.P, segment)
            if depths.min() < 0.1:
                continue
            sizes = camera.K[0, 0] * radius / depths
            links.append((float(depths.mean()), float(depths.min()), i, centres, sizes))
        front: list[Link] = []
        for _, nearest, i, centres, sizes in sorted(links, key=lambda link: -link[0]):
            for scale, level in ((1.0, 96 + 6 * (i % 3)), (0.6, 122 + 6 * (i % 3))):
                outline = _capsule_outline(centres, sizes * scale)
                if nearest + 0.03 < body_depth:
                    front.append((outline, float(level), nearest))
                else:
                    fixed = np.round(np.clip(outline, -4000, 4000) * 16).astype(np.int32)
                    cv2.fillConvexPoly(image, fixed, int(level), cv2.LINE_AA, 4)
        return front

    def _expose(self, image: npt.NDArray[np.float32], rng: np.random.Generator, t_s: float) -> ImageArray:
        if self.settings.lighting is not None:
            image = self.settings.lighting.lit(image, t_s)
        if self.settings.noise_grey <= 0:
            return np.asarray(cv2.add(image, 0.0, dtype=cv2.CV_8U), dtype=np.uint8)
        down, right = rng.integers(0, _NOISE_MARGIN, 2)
        height, width = image.shape
        noise = self._noise[down : down + height, right : right + width]
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def _backdrop(cell: SimulatedCell, pinhole: PinholeCamera, background: str) -> Backdrop:
    if background == "pybullet":
        pass

        return PybulletBackdrop(cell, pinhole)
    return RoomBackdrop(cell, pinhole) if background == "arm" else PlainBackdrop(pinhole)


def draw_body(
    image: npt.NDArray[np.float32], cell: SimulatedCell, camera: PinholeCamera, q: FloatArray
) -> Region | None:
    """Draw the marker body of ``cell`` with the arm at ``q`` (n,), by :func:`draw_faces`."""
    return draw_faces(image, cell.body, cell.body_pose(q), cell.in_world(camera, q))


def draw_faces(
    image: npt.NDArray[np.float32], body: MarkerBody, body_pose: FloatArray, camera: PinholeCamera
) -> Region | None:
    """Draw a body at ``body_pose`` (4, 4) into ``image`` (height, width), [grey levels], without blur and noise.

    Of a solid the faces turned to the camera, shaded by its light. Otherwise faces turned away show their dull backs
    and are drawn first: the body is convex, so no face turned to the camera is hidden by another.

    Returns:
        The region touched (left, top, right, bottom) [px], or None if nothing was drawn.
    """
    if isinstance(body, SolidBody):
        return _draw_solid(image, body, body_pose, camera)
    faces = []
    for face, flange_to_face in zip(body.faces, body.flange_to_face, strict=True):
        pose = body_pose @ flange_to_face
        sight = camera.centre - pose[:3, 3]
        cosine = float(-pose[:3, 2] @ sight / np.linalg.norm(sight))
        faces.append((cosine, face, camera.P @ pose[:, [0, 1, 3]]))
    boxes = []
    for cosine, face, H in sorted(faces, key=lambda item: item[0] > 0):
        s = face.half_side
        corners = np.array([[-s, -s, 1], [s, -s, 1], [s, s, 1], [-s, s, 1.0]]) @ H.T
        if corners[:, 2].min() < 0.05:  # at the camera: cannot be drawn
            continue
        outline = corners[:, :2] / corners[:, 2:]
        if camera.k1 != 0.0:
            outline = bend_outline(camera, outline)
        boxes.append((outline.min(axis=0), outline.max(axis=0)))
        shade = 0.6 + 0.4 * abs(cosine)
        blend_polygon(image, outline, (PLATE_LEVEL if cosine > 0 else BACK_LEVEL) * shade)
        if cosine > 0:
            for centre in face.positions:
                _draw_dot(image, camera, H, centre, face.radius, DOT_LEVEL * shade)
    return _region(boxes, camera)


def _draw_solid(
    image: npt.NDArray[np.float32], body: SolidBody, pose: FloatArray, camera: PinholeCamera
) -> Region | None:
    """Draw a convex solid by the coverage of its faces, so that no background shows where two faces meet."""
    placed = body.vertices @ pose[:3, :3].T + pose[:3, 3]
    pixels, depths = project(camera.P, placed)
    if depths.min() < 0.05:
        return None
    normals = body.face_normals @ pose[:3, :3].T
    fronts = [
        (np.array(outline), level)
        for outline, level, normal in zip(body.outlines, body.shades(pose), normals, strict=True)
        if normal @ (camera.centre - placed[outline[0]]) > 0.0
    ]
    outlines = [pixels[rows] if camera.k1 == 0.0 else bend_outline(camera, pixels[rows]) for rows, _ in fronts]
    region = _region([(outline.min(axis=0), outline.max(axis=0)) for outline in outlines], camera)
    if region is None:
        return None
    left, top, right, bottom = region
    part = image[top:bottom, left:right]
    covered, light = np.zeros_like(part), np.zeros_like(part)
    for outline, (_, level) in zip(outlines, fronts, strict=True):
        face = np.zeros_like(part)
        blend_polygon(face, outline - np.array([left, top]), 1.0)
        covered += face
        light += np.float32(level) * face
    part[...] = part * (1.0 - np.minimum(covered, 1.0)) + light
    return region


def _draw_dot(
    image: npt.NDArray[np.float32],
    camera: PinholeCamera,
    H: FloatArray,
    centre: FloatArray,
    radius: float,
    level: float,
) -> None:
    """Draw a disc at ``centre`` (2,) [m] of the plane that ``H`` (3, 3) maps to ideal pixels."""
    if camera.k1 == 0.0:
        blend_ellipse(image, circle_image(H, centre, radius), level)
        return
    rim = (centre + radius * unit_circle()) @ H[:, :2].T + H[:, 2]
    outline = distort(camera.lens, rim[:, :2] / rim[:, 2:])
    if np.isfinite(outline).all():  # otherwise the lens does not image it
        blend_polygon(image, outline, level)


def circle_image(H: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Conic (3, 3), negative inside, that is the image under ``H`` (3, 3) of a circle in the plane [m]."""
    x, y = centre
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
    inverse = np.linalg.inv(H)
    conic = inverse.T @ circle @ inverse
    return np.asarray(conic / np.abs(conic[0, 0]), dtype=np.float64)


def _region(boxes: list[tuple[FloatArray, FloatArray]], camera: PinholeCamera) -> Region | None:
    if not boxes:
        return None
    low = np.floor(np.min([box[0] for box in boxes], axis=0)) - 3
    high = np.ceil(np.max([box[1] for box in boxes], axis=0)) + 4
    left, top = np.clip(low, 0, [camera.width, camera.height]).astype(int)
    right, bottom = np.clip(high, 0, [camera.width, camera.height]).astype(int)
    return (left, top, right, bottom) if right > left and bottom > top else None


def _apart(regions: list[Region]) -> list[Region]:
    """Disjoint regions: overlapping ones are replaced by their common bounding box, so nothing is blurred twice."""
    if len(regions) == 2:
        (l0, t0, r0, b0), (l1, t1, r1, b1) = regions
        if l0 < r1 and l1 < r0 and t0 < b1 and t1 < b0:
            return [(min(l0, l1), min(t0, t1), max(r0, r1), max(b0, b1))]
    return regions


def _blur(image: npt.NDArray[np.float32], region: Region, sigma: float) -> None:
    left, top, right, bottom = region
    part = image[top:bottom, left:right]
    part[...] = cv2.GaussianBlur(part, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)


def _capsule_outline(centres: FloatArray, sizes: FloatArray) -> FloatArray:
    """Convex outline (k, 2) of the images of a capsule's two end spheres, (2, 2) and (2,) [px]."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = (centres[:, None] + sizes[:, None, None] * ring).reshape(-1, 2)
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


# -- lenses --------------------------------------------------------------------------------------------------
# Lens distortion of simulated images: outlines and whole images from ideal to raw pixels.


CIRCLE_POINTS = 40
"""Corners of the polygon that represents a dot: with equal area, the centre of its image is correct to 1e-4 px."""
PIECE_PX = 20.0
"""Largest length of a straight piece of an outline's edge."""
MOST_PIECES = 64
"""Largest number of pieces of one edge, which may extend far outside the image."""


def unit_circle() -> FloatArray:
    """Corners (CIRCLE_POINTS, 2) of a regular polygon about the origin with the unit circle's area."""
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_POINTS, endpoint=False)
    step = 2.0 * np.pi / CIRCLE_POINTS
    corners: FloatArray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return corners * float(np.sqrt(step / np.sin(step)))


def bend_outline(camera: PinholeCamera, outline: FloatArray) -> FloatArray:
    """A polygon (k, 2) in ideal pixels, distorted by the lens of ``camera``, its edges finely subdivided.

    Corners beyond the fold of the distortion are moved to the rim of the lens's image, which is outside the camera's
    image.
    """
    ways = np.roll(outline, -1, axis=0) - outline
    pieces = np.clip(np.ceil(np.linalg.norm(ways, axis=1) / PIECE_PX), 1, MOST_PIECES).astype(int)
    share = np.concatenate([np.arange(n) / n for n in pieces])[:, None]
    fine = np.repeat(outline, pieces, axis=0) + share * np.repeat(ways, pieces, axis=0)
    k, centre, r0 = camera.lens[0], camera.lens[1:3], camera.lens[3]
    offset = fine - centre
    if k < 0.0:
        rim = 0.999 * r0 * np.sqrt(-1.0 / (3.0 * k))
        reach = np.linalg.norm(offset, axis=1, keepdims=True)
        offset = offset * np.minimum(1.0, rim / np.maximum(reach, 1e-9))
    return distort(camera.lens, centre + offset)


class BentImage:
    """Distorts the image of ``pinhole``, a larger one without distortion at the same pose, into a camera's image."""

    def __init__(self, camera: PinholeCamera) -> None:
        """Raises ValueError if the distorted image ends inside the image."""
        if not camera.sees_whole_image:
            raise ValueError(f"camera {camera.name!r}: k1 = {camera.k1:g} leaves the image's corners dark")
        self.camera = camera
        self.has_distortion = camera.k1 != 0.0
        self.origin = np.zeros(2)
        self.pinhole = camera
        self._source: ImageArray | None = None
        self._bent: ImageArray | None = None
        if not self.has_distortion:
            return
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
        ideal = undistort(camera.lens, np.stack([u, v], axis=-1))
        self.origin = np.floor(ideal.min(axis=(0, 1)))
        size = np.ceil((ideal.max(axis=(0, 1)) - self.origin + 2.0) / 2.0).astype(int) * 2
        K = camera.K.copy()
        K[:2, 2] -= self.origin
        self.pinhole = replace(camera, K=K, width=int(size[0]), height=int(size[1]), k1=0.0)
        self._map = cv2.convertMaps((ideal - self.origin).astype(np.float32), None, cv2.CV_16SC2)

    def image(self, source: ImageArray) -> ImageArray:
        """Distort the pinhole's image; the last result is cached."""
        if not self.has_distortion:
            return source
        if self._bent is None or source is not self._source:
            bent = cv2.remap(source, *self._map, interpolation=cv2.INTER_LINEAR)
            self._source, self._bent = source, np.asarray(bent, dtype=np.uint8)
        return self._bent

    def outline(self, corners: FloatArray) -> FloatArray:
        """Distort a polygon (k, 2) of the pinhole's image."""
        return bend_outline(self.camera, corners + self.origin) if self.has_distortion else corners


# -- the backdrop --------------------------------------------------------------------------------------------
# Background images behind the markers, redrawn rarely: a room, a uniform grey, or the arm by pybullet.


REFRESH_FRAMES = 15
REFRESH_MOVE = 0.05  # [rad], least motion of some joint
PLAIN_LEVEL = 90


class Backdrop:
    """Background images too slow for every frame: cached until the arm has moved and some frames have passed."""

    def __init__(self) -> None:
        self._age = 0
        self._q: FloatArray | None = None
        self._image: ImageArray | None = None

    def draw(self, q: FloatArray) -> ImageArray:
        """The image (height, width) with the arm at ``q`` (n,) [rad]."""
        raise NotImplementedError

    def image(self, q: FloatArray) -> ImageArray:
        """Cached image (height, width) for the arm near ``q`` (n,) [rad]."""
        self._age += 1
        moved = self._q is None or float(np.abs(q - self._q).max()) > REFRESH_MOVE
        if self._image is None or (moved and self._age >= REFRESH_FRAMES):
            self._image, self._q, self._age = self.draw(q), q.copy(), 0
        return self._image


class RoomBackdrop(Backdrop):
    """A wall and a floor, dimmer than the dots and unevenly lit, as seen by a pinhole ``camera`` of the rig."""

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera) -> None:
        super().__init__()
        self._cell = cell
        self._camera = camera

    def image(self, q: FloatArray) -> ImageArray:
        """Image of the room; drawn once for a static camera."""
        if self._image is not None and self._cell.stand is None:
            return self._image
        return super().image(q)

    def draw(self, q: FloatArray) -> ImageArray:
        """Image of the room from the camera's pose with the arm at ``q`` (n,) [rad]."""
        camera = self._cell.in_world(self._camera, q)
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
        wall = 100 + 18 * np.cos(u / camera.width * 2.2) - 12 * v / camera.height
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
        rays = rays @ camera.world_to_camera[:3, :3]
        with np.errstate(divide="ignore"):
            reach = np.where(rays[..., 2] < -1e-3, -camera.centre[2] / rays[..., 2], np.inf)
        ground = camera.centre[:2] + np.where(np.isfinite(reach), reach, 0)[..., None] * rays[..., :2]
        tiles = 82 + 9 * ((np.floor(ground[..., 0] / 0.4) + np.floor(ground[..., 1] / 0.4)) % 2)
        room = np.where(reach < 6.0, tiles, wall)
        return np.asarray(cv2.GaussianBlur(room.astype(np.float32), (0, 0), 1.0)).astype(np.uint8)


class PlainBackdrop(Backdrop):
    """Uniform grey background."""

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._image = np.full((camera.height, camera.width), PLAIN_LEVEL, dtype=np.uint8)

    def image(self, q: FloatArray) -> ImageArray:
        """The uniform image, for any ``q``."""
        assert self._image is not None
        return self._image


SHRINK = 2  # rendered at half size and enlarged: a quarter of the cost, and the lens blurs it in any case
NEAR, FAR = 0.05, 8.0  # clipping planes [m]
BRIGHTNESS = 0.6  # factor on pybullet's lamp


class PybulletBackdrop(Backdrop):
    """Background with the arm by pybullet's renderer, for a pinhole ``camera`` of the cell's rig."""

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera) -> None:
        from stereoservo_sim.world.physics import PhysicsError, import_pybullet, load_robot

        super().__init__()
        self._bullet = import_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("pybullet refuses another simulation in this process")
        self._cell = cell
        self._loaded = load_robot(self._bullet, self._client, cell.robot)
        floor = self._bullet.createVisualShape(
            self._bullet.GEOM_BOX,
            halfExtents=[3, 3, 0.01],
            rgbaColor=[0.35, 0.35, 0.38, 1],
            physicsClientId=self._client,
        )
        self._bullet.createMultiBody(
            baseVisualShapeIndex=floor, basePosition=[0, 0, -0.01], physicsClientId=self._client
        )
        self._camera = camera
        self._projection = projection_matrix(camera).T.ravel().tolist()

    def draw(self, q: FloatArray) -> ImageArray:
        """Image of the arm at ``q`` (n,) [rad]."""
        own = self._loaded.coupling @ q + self._loaded.offsets
        for joint, position in zip(self._loaded.joints, own.tolist(), strict=True):
            self._bullet.resetJointState(self._loaded.body, joint, position, physicsClientId=self._client)
        camera = self._cell.in_world(self._camera, q)
        view = (np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.world_to_camera).T.ravel().tolist()
        _, _, rgba, _, _ = self._bullet.getCameraImage(
            camera.width // SHRINK,
            camera.height // SHRINK,
            viewMatrix=view,
            projectionMatrix=self._projection,
            shadow=0,
            renderer=self._bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        grey = (
            np.reshape(rgba, (camera.height // SHRINK, camera.width // SHRINK, 4))[..., :3].mean(axis=-1) * BRIGHTNESS
        )
        enlarged = cv2.resize(grey.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.clip(enlarged, 0, 255), dtype=np.uint8)


def projection_matrix(camera: PinholeCamera) -> FloatArray:
    """OpenGL projection (4, 4) of a pinhole with pixels centred on integers."""
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    return np.array(
        [
            [2 * fx / camera.width, 0, 1 - 2 * (cx + 0.5) / camera.width, 0],
            [0, 2 * fy / camera.height, 2 * (cy + 0.5) / camera.height - 1, 0],
            [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
            [0, 0, -1, 0],
        ]
    )
