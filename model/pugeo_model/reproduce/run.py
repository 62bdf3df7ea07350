# SPDX-License-Identifier: Apache-2.0
"""`pugeo reproduce`: measure, draw, and write docs/paper.md part by part."""

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from pugeo_model.cloud import Cloud
from pugeo_model.metrics.evaluation import truths
from pugeo_model.metrics.report import require
from pugeo_model.reproduce import tables
from pugeo_model.reproduce.budget import draw_curves, full_schedule
from pugeo_model.reproduce.document import figures_table, lines_table, section
from pugeo_model.reproduce.geometry import draw_histograms, verify
from pugeo_model.reproduce.printed import PRINTED_COLUMNS
from pugeo_model.reproduce.robustness import NOISE, Shown, draw, few_points, lidar, noisy_points
from pugeo_model.reproduce.rows import RowStore, Setting
from pugeo_model.reproduce.trained import RATIOS, Trained
from pugeo_model.upsampler import Upsampler

__all__ = ["PARTS", "Reproduction"]

PARTS = ("comparison", "normals", "ablation", "geometry", "robustness")
"""Tables 1 to 3, the last figure, and the three robustness figures."""

_GEOMETRY_RATIO = 4
_SHOWN = 4  # shapes in the figure of few points

_TITLES = {
    "comparison": "Table 1: comparison",
    "normals": "Table 2: predicted normals against PCA, by reconstruction at R = 8",
    "ablation": "Table 3: ablation at R = 8",
    "geometry": "Figure: is the geometry what the theory says?",
    "robustness": "Figures: few points, noise, LiDAR",
}

_HEAD = """# The paper, reproduced

"PUGeo-Net: A Geometry-centric Network for 3D Point Cloud Upsampling" (Qian, Hou, Kwong, He, ECCV
2020), measured with the code of this repository on its own validation shapes. Every part is made
by the command above it. Each cell is our number, then the paper's own in brackets. They cannot
be compared directly: the paper tests on 13 other models, trains 800 epochs on a GPU, and
runs Poisson reconstruction with one sample a node (ours 1.5). Units: P2F in 1e-3 of the longest
side, all other distances and JSD in 1e-2.

Size is the weights and Adam's two moments, in float32. Our sizes of PUGeo-Net and PU-Net differ
from the paper's by at most 2 %.

Made anew, the row of PUGeo-Net at R = 4 had the same digits; it took 122 seconds of a core of an
AMD EPYC with AVX2, on which all others were measured too.

Two formulas of the paper contain errors, which the code corrects: the unoriented normal loss is the
*smaller* of both signs, not the larger (`training/patches/losses.py`), and the last level is
weighted by its softmax weight `w`, not by the logit `a_hat` (`network/backbones/dgcnn.py`).
"""

_NOTES = {
    "comparison": (
        "PU-Net and MPU predict no normals: theirs are a PCA of 16 neighbours, as in the paper. "
        "A dash means: not measured. Reasons for differences from the paper: other shapes, on "
        "whose thin parts HD and the columns of surfaces depend; some hundred training steps "
        "instead of 240,000 (normals are learned last, so reconstructed surfaces suffer most); "
        "another implementation of EAR (`benchmarks/ear.py`), with normals of a fitted quadric "
        "whose signs come from a spanning tree: where one is wrong, its surface is inside out. "
        "Ours is averaged with weights that were trained on from it for 5,739 steps more."
    ),
    "normals": (
        "Normals of the same points, predicted or by PCA of 10 to 45 neighbours. The PCA's get the "
        "signs of the predicted ones, so that directions alone are compared. Of the network as "
        "published, trained briefly, a PCA is still the better one; of ours it is not."
    ),
    "ablation": (
        "Each line is a recipe that leaves out one part of the full model; data, seed, steps and "
        "loss weights are the same; hours are those of a busy machine. After 250 steps all lines "
        "of the network as published are within 2 % of each other in CD: such a budget does not "
        "tell its parts apart. Of ours the full model is the best in CD, HD and P2F; without T it "
        "is the worst in all three, as the paper's is in CD."
    ),
    "geometry": (
        "5,000 even points of a sphere of diameter 1 and of a cube of side 1. T holds the tangents "
        "`t1, t2` and the normal `t3`; our served network makes T orthonormal, so that its angle "
        "is zero by construction and the displacement and curvature are what there is to learn. "
        "Curvatures come from the second fundamental form of the learned `Y(u, v) = x + T (u, v, "
        "delta)`, stretches from the first. True are -1 x r on the sphere, 0 on faces."
    ),
    "robustness": (
        "Inputs above, outputs at R = 16 below, lit by their predicted normals. Numbers are CD "
        "(1e-2) and P2F (1e-3) of output and input against the true mesh; there is no truth for "
        "the LiDAR frame, a part of one of KITTI (CC BY-NC-SA 3.0)."
    ),
}


class Reproduction:
    """All parts of the document, each kept in a file of its own until the others are made anew.

    Args:
        meshes: folder of validation meshes, longest side 1.
        samples: folder with ``inputs/`` and ``gt/`` samples of them.
        folder: of the trained networks and of all measured rows.
        served: released weights, or the path of a ``.safetensors`` file.
        document: where the Markdown goes; pictures go to ``images/paper`` beside it.
        kitti: a Velodyne frame, or ``None``.
        surfaces: measure reconstructed surfaces too.
        anew: measure rows again that are known.
        tick: called with a key and the shape at hand.
    """

    def __init__(
        self,
        meshes: Path,
        samples: Path,
        folder: Path,
        served: str,
        document: Path,
        kitti: Path | None = None,
        *,
        surfaces: bool = True,
        anew: bool = False,
        tick: Callable[[str, str], None] = lambda _key, _shape: None,
    ) -> None:
        require(surfaces=surfaces, pictures=True)
        self._folder, self._served, self._document = folder, served, document
        self._meshes, self._samples, self._kitti = meshes, samples, kitti
        self._shapes = list(truths(meshes))
        setting = Setting(self._shapes, samples, surfaces=surfaces)
        self._store = RowStore(folder / "rows.json", setting, tick, anew=anew)
        self._tick = tick
        self._pictures = document.parent / "images" / "paper"

    def make(self, parts: Iterable[str]) -> None:
        """Make these parts anew and write the document from them and those made before."""
        made = self._folder / "parts.json"
        known: dict[str, str] = json.loads(made.read_text("utf-8")) if made.exists() else {}
        makers = {
            "comparison": self._comparison,
            "normals": self._normals,
            "ablation": self._ablation,
            "geometry": self._geometry,
            "robustness": self._robustness,
        }
        for part in parts:
            body, seconds = makers[part]()
            command = f"pugeo reproduce --part {part}"
            known[part] = section(_TITLES[part], command, seconds, _NOTES[part], body)
            self._folder.mkdir(parents=True, exist_ok=True)
            made.write_text(json.dumps(known, indent=1) + "\n", "utf-8")
        text = "\n".join([_HEAD, *(known[part] for part in PARTS if part in known)])
        self._document.parent.mkdir(parents=True, exist_ok=True)
        self._document.write_text(text, "utf-8")

    def _comparison(self) -> tuple[str, float]:
        table, spent = self._table(tables.comparison(self._store, self._folder, self._served))
        return "\n\n".join([table, *self._budget()]), spent

    def _normals(self) -> tuple[str, float]:
        lines = tables.normals(self._store, self._folder, self._served)
        return self._table(lines, ("CD#", "HD#", "JSD#"))

    def _ablation(self) -> tuple[str, float]:
        return self._table(tables.ablation(self._store, self._folder))

    def _budget(self) -> list[str]:
        """The time of training, and its curves at R = 4 where runs have logs."""
        parts, logs = [], {}
        for recipe in ("paper", "pu_net", "mpu"):
            which = Trained(recipe, RATIOS[0])
            card, log = which.card(self._folder), which.weights(self._folder).with_name("log.csv")
            if card is None:
                continue
            parts.append(f"- {tables.LABELS[recipe]}: {full_schedule(card)}.")
            if log.exists():
                logs[tables.LABELS[recipe]] = log
        if not logs:
            return ["\n".join(parts)] if parts else []
        target = self._picture("curves.png")
        draw_curves(logs, target)
        return ["\n".join(parts), self._link("validation losses over hours", target)]

    def _table(
        self, lines: Iterable[tables.Line], columns: tuple[str, ...] = PRINTED_COLUMNS
    ) -> tuple[str, float]:
        """A table and the seconds that its rows took when they were measured."""
        made = list(lines)
        spent = sum(line.row.spent for line in made if line.row is not None)
        return lines_table(made, columns), spent

    def _geometry(self) -> tuple[str, float]:
        begun = time.process_time()
        rows: dict[str, dict[str, float]] = {}
        pictures: list[str] = []
        for name, weights in self._with_geometry():
            self._tick("geometry", name)
            found = list(verify(weights, _GEOMETRY_RATIO))
            rows |= {f"{name}, {each.name}": each.numbers() for each in found}
            target = self._picture(f"geometry_{Path(weights).stem}.png")
            draw_histograms(found, target)
            pictures.append(self._link(name, target))
        return "\n\n".join([figures_table(rows), *pictures]), time.process_time() - begun

    def _with_geometry(self) -> Iterable[tuple[str, str]]:
        yield f"ours (`{self._served}`)", self._served
        paper = Trained("paper", _GEOMETRY_RATIO).weights(self._folder)
        if paper.exists():
            yield tables.LABELS["paper"], str(paper)

    def _robustness(self) -> tuple[str, float]:
        begun = time.process_time()
        upsampler = Upsampler(self._served)

        def method(cloud: Cloud, ratio: float) -> Cloud:
            return upsampler(cloud, ratio).cloud

        shapes = self._shapes[:_SHOWN]
        groups: dict[str, list[Shown]] = {
            "few_points": [few_points(method, truth) for truth in shapes],
            "noise": [noisy_points(method, shapes[0], sigma) for sigma in NOISE],
        }
        if self._kitti is not None:
            groups["lidar"] = [lidar(method, self._kitti)]
        rows: dict[str, dict[str, float]] = {}
        pictures: list[str] = []
        for name, shown in groups.items():
            self._tick("robustness", name)
            target = self._picture(f"{name}.png")
            draw(shown, target)
            pictures.append(self._link(name.replace("_", " "), target))
            rows |= {each.name: each.figures for each in shown if each.figures}
        return "\n\n".join([figures_table(rows), *pictures]), time.process_time() - begun

    def _picture(self, name: str) -> Path:
        self._pictures.mkdir(parents=True, exist_ok=True)
        return self._pictures / name

    def _link(self, name: str, target: Path) -> str:
        return f"![{name}]({target.relative_to(self._document.parent).as_posix()})"
