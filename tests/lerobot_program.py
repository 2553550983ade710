"""Program for a Python that has LeRobot (0.3 to 0.6): writes data sets by its own writer, and what its reader returns.

``lerobot_program.py write FOLDER PICTURES.npz ORDER.json`` and ``lerobot_program.py read FOLDER ANSWER.npz``.
"""

import inspect
import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

NAME = "local/set"


def write(folder, given, order):
    """``given``: ``state`` (r, n), and each camera's pictures (r, h, w, 3), red first; ``order``: ``lengths``, …"""
    names = ["height", "width", "channels"]
    kind = "video" if order["videos"] else "image"
    features = {
        f"observation.images.{camera}": {"dtype": kind, "shape": given[camera].shape[1:], "names": names}
        for camera in order["cameras"]
    }
    states = order["names"]
    features["observation.state"] = {"dtype": "float32", "shape": (len(states),), "names": states}
    options = {"use_videos": order["videos"], **order.get("options", {})}
    known = inspect.signature(LeRobotDataset.create).parameters
    data = LeRobotDataset.create(
        NAME,
        order["fps"],
        root=folder,
        features=features,
        **{name: value for name, value in options.items() if name in known},
    )
    if "files_mb" in order and hasattr(data.meta, "update_chunk_settings"):  # format 3.0
        size = order["files_mb"]
        data.meta.update_chunk_settings(chunks_size=2, data_files_size_in_mb=size, video_files_size_in_mb=size)
    columns = {f"observation.images.{camera}": given[camera] for camera in order["cameras"]}
    columns["observation.state"] = given["state"].astype(np.float32)
    row = 0
    for length in order["lengths"]:
        for _ in range(length):
            frame = {name: values[row] for name, values in columns.items()}
            if "task" in inspect.signature(data.add_frame).parameters:  # lerobot 0.3
                data.add_frame(frame, "test")
            else:
                data.add_frame(frame | {"task": "test"})
            row += 1
        data.save_episode()
    if hasattr(data, "finalize"):
        data.finalize()


def read(folder, answer):
    """Columns of what the reader returns for each row. The backend: torchcodec needs FFmpeg's shared libraries."""
    data = LeRobotDataset(NAME, root=folder, video_backend="pyav")
    rows = [data[k] for k in range(len(data))]
    columns = {name: np.array([np.asarray(row[name]) for row in rows]) for name in rows[0] if name != "task"}
    np.savez(answer, **columns)


if __name__ == "__main__":
    what, folder, *files = sys.argv[1:]
    if what == "write":
        with np.load(files[0]) as given:
            write(Path(folder), dict(given), json.loads(Path(files[1]).read_text()))
    else:
        read(Path(folder), files[0])
