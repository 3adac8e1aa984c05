"""``python -m arbiview_aug check``: mistakes that rendering cannot notice, and the labels drawn into the images."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from arbiview_aug.atomic_io import file_name
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.arguments import chosen_frames, data, gathered_warnings, is_rig, reading, writable_folder
from arbiview_aug.datasets.registry import open_data
from arbiview_aug.evaluate.metrics import as_arrays
from arbiview_aug.evaluate.report.pictures import draw_labels, save_picture
from arbiview_aug.sample.camera_mistakes import neighbour_errors
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.mistakes import CheckReport, check, check_own_car, check_rig

_MOST_FRAMES = 8  # in memory at once, to look for the own car in


def run(arguments: argparse.Namespace) -> int:
    """Print one line for each finding, and draw the first frame; 1 if there are findings."""
    if is_rig(arguments.data):
        report = CheckReport(tuple(check_rig(load_rig(arguments.data))))
        print(report)
        return int(not report.ok)
    folder = writable_folder(Path(arguments.output), arguments.output)
    notes: list[str] = []
    with gathered_warnings(notes):
        samples = open_data(data(arguments.data), **reading(arguments))
        chosen = chosen_frames(arguments.frames, len(samples))
        lines: dict[tuple[str, str], list[str]] = {}
        frames: list[Frame] = []
        errors: dict[tuple[str, str], list[FloatArray]] = {}
        for index in chosen:
            sample = samples[index]
            if index in chosen[:: -(-len(chosen) // _MOST_FRAMES)]:
                frames += read_frames(sample, None)
            for finding in check(sample).findings:
                lines.setdefault((finding.where, finding.fix), []).append(str(finding))
            for pair, pair_errors in neighbour_errors(sample["rig"], sample["images"]).items():
                errors.setdefault(pair, []).append(pair_errors)
            if index == chosen[0]:
                labels = sample.get("points"), sample.get("boxes_3d")
                points, boxes = (None if value is None else value.numpy() for value in labels)
                for camera, image in zip(sample["rig"], as_arrays(sample["images"]), strict=True):
                    picture = draw_labels(camera, image, points, boxes)
                    save_picture(folder / f"check-{file_name(camera.name)}.png", picture)
        for finding in check_own_car(frames):
            lines[finding.where, finding.fix] = [str(finding)] * len(chosen)
    for note in notes:
        print(note)
    for findings in lines.values():
        print(findings[0] if len(chosen) == 1 else f"{findings[0]} ({len(findings)} of {len(chosen)} frames)")
    if errors:
        angles = [f"{', '.join(pair)} {np.median(np.concatenate(parts)):.2f}" for pair, parts in errors.items()]
        print(f"degrees between matches of neighbouring cameras, median: {'; '.join(angles)}")
    count = len(notes) + len(lines)
    summary = f"{count or 'no'} finding{'s' * (count != 1)} in {len(chosen)} of {len(samples)} frames"
    print(f"{summary}; pictures: {folder}/check-*.png")
    return int(count > 0)
