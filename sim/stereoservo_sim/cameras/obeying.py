"""What each order does to the emulated cameras and their streams."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from stereoservo_sim.cameras.camera import EmulatedCamera
from stereoservo_sim.cameras.orders import ALL, Order, help_lines
from stereoservo_sim.emulation.errors import OrderError

if TYPE_CHECKING:
    from stereoservo_sim.cameras.studio import Studio

Undo = Callable[[], None]


def nothing() -> None:
    """What is undone where nothing is to be."""


def obey(studio: Studio, order: Order) -> tuple[str, Undo]:
    """Do it now; the answer, and what takes it back. Raises OrderError."""
    if order.verb in ("status", "help"):
        return "\n".join(studio.status() if order.verb == "status" else help_lines()), nothing
    if order.verb == "swap":
        first, second = studio.named(order.camera)[0], studio.named(order.what)[0]
        studio.swap(first, second)
        return f"{first.name} and {second.name}: swapped", lambda: studio.swap(first, second)
    answers, undos = [], []
    for camera in studio.named(order.camera):
        answer, undo = _ACTS[order.verb](studio, camera, order)
        answers.append(f"{camera.name}: {answer}")
        undos.append(undo)

    def undo_all() -> None:
        for undo in undos:
            undo()

    return "\n".join(answers), undo_all


def check(studio: Studio, order: Order) -> None:
    """Raise OrderError where the order speaks of a camera that is not there."""
    for name in (order.camera, order.what if order.verb == "swap" else ""):
        if name and name != ALL:
            studio.named(name)


def _set(camera: EmulatedCamera, answer: str, **marks: object) -> tuple[str, Undo]:
    before = {name: getattr(camera.condition, name) for name in marks}

    def undo() -> None:
        for name, value in before.items():
            setattr(camera.condition, name, value)

    for name, value in marks.items():
        setattr(camera.condition, name, value)
    return answer, undo


def _freeze(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, "frozen", frozen=True)


def _drop(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, "its pictures are lost", gone=True)


def _stall(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    studio.stalled.add(camera.stream)
    return "stalls", lambda: studio.stalled.discard(camera.stream)


def _disconnect(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    studio.hang_up(camera.stream)
    return "connections closed", nothing


def _cut(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    studio.hang_up(camera.stream, within=True)
    return "connections end in the middle of the next picture", nothing


def _refuse(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    studio.refused.add(camera.stream)
    studio.hang_up(camera.stream)
    return "connections refused", lambda: studio.refused.discard(camera.stream)


def _latency(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"latency {order.time_ns * 1e-6:g} ms", latency_ns=order.time_ns)


def _jitter(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"jitter {order.time_ns * 1e-6:g} ms", jitter_ns=order.time_ns)


def _skew(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    before = camera.view.phase_s
    camera.view.change(phase_s=order.time_ns * 1e-9)
    return f"skew {order.time_ns * 1e-6:g} ms", lambda: camera.view.change(phase_s=before)


def _loss(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    before = camera.view.drop_rate
    camera.view.change(drop_rate=order.number)
    return f"loses {order.number:.0%} of its pictures", lambda: camera.view.change(drop_rate=before)


def _exposure(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"exposure {order.number:g}", gain=order.number)


def _lamp(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"lamp {order.what}", lamp=order.what == "on")


def _look(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, order.verb, look=order.verb)


def _size(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"{order.size[0]}x{order.size[1]}", size=order.size)


def _truncate(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"{order.number:g} JPEGs end in the middle", truncate=int(order.number))


def _corrupt(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    return _set(camera, f"{order.number:g} JPEGs spoilt", corrupt=int(order.number))


def _bump(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    if order.what == "back":
        camera.put_back()
        return "where it stood at first", nothing
    try:
        camera.bump(order.number, order.length_m, "xyz".index(order.what))
    except ValueError as error:
        raise OrderError(str(error)) from error
    return (
        f"turned by {order.number:g} deg about {order.what}, shifted by {order.length_m * 1e3:g} mm",
        nothing,
    )


def _clear(studio: Studio, camera: EmulatedCamera, order: Order) -> tuple[str, Undo]:
    camera.clear()
    for marks in (studio.stalled, studio.refused):
        marks.discard(camera.stream)
    studio.unswap(camera)
    return "as the cell file has it", nothing


_ACTS: dict[str, Callable[[Studio, EmulatedCamera, Order], tuple[str, Undo]]] = {
    "freeze": _freeze, "drop": _drop, "stall": _stall, "disconnect": _disconnect, "cut": _cut, "refuse": _refuse,
    "latency": _latency, "jitter": _jitter, "skew": _skew, "loss": _loss, "exposure": _exposure, "lamp": _lamp,
    "black": _look, "white": _look, "flip": _look, "mirror": _look, "size": _size, "truncate": _truncate,
    "corrupt": _corrupt, "bump": _bump, "clear": _clear,
}  # fmt: skip
