"""Training of one map: AdamW, cosine, average of the weights; log, learning curve, checkpoints. A resumed run is bitwise equal on the CPU.

The loss is that of `learner`, summed over the networks that are trained together: they share their batches and nothing else.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from biem.errors import NumericalFailure
from biem.membrane.maps import LAYERS
from biem.run.files import write_atomically
from biem.run.simulate import Stopped, commit, stop_signals
from biem.scene.tables import flat
from surrogate.config import Training
from surrogate.damping import Relax, least_damping
from surrogate.data import Source
from surrogate.learned import LearnedMaps, Loaded
from surrogate.learner import VALIDATED, Errors, make_learner
from surrogate.networks import LearnedMap, Settings
from surrogate.pairs import Pairs
from surrogate.targets import TARGETS
from surrogate.weights import Card, checkpoint_bytes, read_checkpoint, save_weights

WARM_UP = 100  # steps
STABLE_SHAPES = 96  # that a relaxation network is tried on, in steps one after another


@dataclass(frozen=True)
class Job:
    """What is trained: a map, of an IVNet one mode or several at once. out: folder of the runs; step: of relax, for its name."""

    map: str
    modes: tuple[int, ...]
    out: Path
    step: str = ""

    @property
    def name(self) -> str:
        if not self.modes:
            return self.map + (f"-{self.step}" if self.step else "")
        return f"{self.map}-{self.modes[0]:02d}" + (f"-{self.modes[-1]:02d}" if len(self.modes) > 1 else "")


def settings_of(config: Training, job: Job, points: int) -> Settings:
    """Of a job's network. Raises ValueError."""
    n = config.network
    common: dict[str, Any] = {"blocks": n.blocks, "width": n.width}
    rolloff = None
    if n.arch == "ivnet":
        if n.rolloff is not None:
            raise ValueError(f'network.rolloff = {n.rolloff:g} is not for network.arch = "ivnet": each mode has a network of its own')
        if points % 2**n.levels:
            raise ValueError(f"network.levels = {n.levels}: {points} nodes cannot be halved so often")
        common |= {"levels": n.levels, "growth": n.growth, "activation": n.activation, "norm": n.norm}
    elif job.map in ("advection", "flow_tension"):  # the forces of near layers are rough
        rolloff = n.rolloff
    return Settings(job.map, n.arch, points, tuple(n.channels), job.modes if n.arch == "ivnet" else (), common, rolloff=rolloff)


def train(config: Training, job: Job, pairs: Pairs, *, device: str = "cpu", progress: bool = True, stop_after: int | None = None) -> Path:
    """Trains, or goes on with, one job; returns its file of weights. stop_after: steps of this call, to be gone on with later.

    Raises ValueError for a run folder made with other settings or data, NumericalFailure for a loss that is not finite: the last good
    checkpoint stays.
    """
    config = config.of(job.map)
    folder = job.out / job.name
    weights = folder / "weights.safetensors"
    wanted = {"training": config.model_dump(mode="json", exclude={"map"}), "data": pairs.digest, "map": job.map, "modes": list(job.modes)}
    _same_run(folder, wanted)
    if weights.exists():
        return weights
    run = _Run(config, job, pairs, folder, device)
    run.load()
    run.go(progress, stop_after)
    if run.step < run.steps:
        return folder / "checkpoint.pt"
    run.finish(weights)
    return weights


def _same_run(folder: Path, wanted: dict[str, Any]) -> None:
    """Raises ValueError where the folder is of another training; makes it where there is none."""
    path = folder / "run.json"
    if path.exists():
        found = json.loads(path.read_text())
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            a, b = flat(found), flat(wanted)
            keys = [f"{k} = {b.get(k)!r} (there {a.get(k)!r})" for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k)]
            raise ValueError(f"{folder} is of another training: {', '.join(keys[:4])}; choose another folder, or remove it")
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(wanted, indent=1).encode())


class _Run:
    """One training, from its data to its weights."""

    def __init__(self, config: Training, job: Job, pairs: Pairs, folder: Path, device: str) -> None:
        self.training, self.job, self.pairs, self.folder, self.device = config.training, job, pairs, folder, device
        settings = settings_of(config, job, pairs.points)
        pairs.check(job.map, settings.modes or (tuple(range(pairs.points // 2 + 1)) if TARGETS[job.map].operator else ()))
        residual = config.network.target == "residual"
        if residual and job.map == "near":
            raise ValueError('network.target = "residual" is not for near: its exact maps are direct quadrature already')
        self.source = Source(pairs, settings, config.network.base_points if residual else None)
        path = folder / "checkpoint.pt"
        self.found = read_checkpoint(path) if path.exists() else None
        self.learner = make_learner(self.source, self.training, config.network.rank, device, self.found and self.found["kept"])
        t = self.training
        self.core = self.learner.network.core
        self.optimizer = torch.optim.AdamW(self.core.parameters(), lr=t.lr, weight_decay=t.weight_decay)
        self.generator = torch.Generator().manual_seed(t.seed)
        self.steps = max(1, round(t.samples / t.batch))
        self.step, self.seconds = 0, 0.0

    def go(self, progress: bool, stop_after: int | None) -> None:
        """Steps to the end, or so many. Raises Stopped after a signal, with a checkpoint."""
        t = self.training
        last = self.steps if stop_after is None else min(self.steps, self.step + stop_after)
        begin, before = time.perf_counter(), self.seconds
        self.learner.network.train()
        bar = tqdm(total=self.steps, initial=self.step, desc=self.job.name, unit="step", disable=not progress, mininterval=0.5)
        with bar, stop_signals() as stop:
            while self.step < last:
                loss = self._advance()
                bar.update()
                stopping = stop()
                if self.step % t.every == 0 or self.step == last or stopping:
                    self.seconds = before + time.perf_counter() - begin
                    found = self._record(loss)
                    bar.set_postfix(median=f"{found['median']:.2e}", mean=f"{found['mean']:.2e}")
                if stopping and self.step < self.steps:
                    raise Stopped(f"{self.job.name} stopped at step {self.step} of {self.steps}; the same command goes on")

    def _advance(self) -> float:
        t = self.training
        rows = torch.randint(len(self.learner), (t.batch,), generator=self.generator)
        for group in self.optimizer.param_groups:
            group["lr"] = t.lr * min(1.0, (self.step + 1) / WARM_UP) * 0.5 * (1.0 + math.cos(math.pi * self.step / self.steps))
        losses = self.learner.losses(rows)
        if not bool(torch.isfinite(losses).all()):
            self._stop_at(rows)
        self.optimizer.zero_grad()
        losses.sum().backward()
        self.learner.clip(t.clip)
        self.optimizer.step()
        self.step += 1
        self.learner.step_average(min(t.ema, self.step / (self.step + 10)))
        return float(losses.detach().mean())

    def _stop_at(self, rows: Tensor) -> NoReturn:
        batch = [self.learner.shape_of(int(row)) for row in rows]
        wrong = [batch[i] for i in np.flatnonzero(~np.isfinite(self.learner.errors_of(rows)))]
        named = ", ".join(f"row {row} (run {self.pairs.run[row]}, symmetry {image})" for row, image in wrong[:3])
        raise NumericalFailure(
            f"{self.job.name}: the loss is not finite at step {self.step + 1}, in the batch of rows {[row for row, _ in batch[:5]]}...; of "
            f"{len(wrong)} of its {len(batch)} shapes, such as {named or 'none'}. {self._last_good()}"
        )

    def _last_good(self) -> str:
        path = self.folder / "checkpoint.pt"
        return (
            f"The last good checkpoint is {path}: lower training.lr" if path.exists() else "There is no checkpoint yet: lower training.lr"
        )

    def _record(self, loss: float) -> dict[str, float]:
        """Checkpoint and a line of the log; returns the validation errors."""
        if not all(bool(torch.isfinite(p).all()) for p in self.core.parameters()):
            raise NumericalFailure(f"{self.job.name}: weights are not finite at step {self.step}. {self._last_good()}")
        found = self.learner.errors("val", VALIDATED).summary()
        content = {
            "step": self.step,
            "seconds": self.seconds,
            "kept": self.learner.keep(),
            "core": self.core.state_dict(),
            "average": self.learner.average,
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
        }
        write_atomically(self.folder / "checkpoint.pt", checkpoint_bytes(content))
        line = {"step": self.step, "samples": self.step * self.training.batch, "seconds": round(self.seconds, 1), "loss": loss, **found}
        with (self.folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(line) + "\n")
        return found

    def load(self) -> None:
        """Goes on from the checkpoint, if there is one."""
        found = self.found
        if found is None:
            (self.folder / "log.jsonl").unlink(missing_ok=True)
            return
        self.core.load_state_dict(found["core"])
        self.learner.average = {name: value.to(self.device) for name, value in found["average"].items()}
        self.optimizer.load_state_dict(found["optimizer"])
        self.generator.set_state(found["generator"])
        self.step, self.seconds = found["step"], found["seconds"]
        lines = [line for line in read_log(self.folder) if line["step"] <= self.step]  # of a run killed between checkpoint and log
        write_atomically(self.folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in lines).encode())

    def finish(self, path: Path) -> None:
        """Weights with their card, learning curve."""
        test = self.learner.errors("test").values
        network = self.learner.network
        self.core.load_state_dict(self.learner.average)
        network.eval()
        pairs, name = self.pairs, self.job.map
        card = Card(
            settings=network.settings.as_dict(),
            target="full" if self.source.base_points is None else "residual",
            base_points=self.source.base_points,
            reduced_area=pairs.reduced_area,
            dt=pairs.dt if name == "relax" else None,
            relaxation=pairs.relaxation if name == "relax" else None,
            layers=list(LAYERS) if name == "near" else None,
            operator_points=pairs.operator_points,
            data=pairs.digest,
            shapes=len(self.learner.rows),
            samples=self.steps * self.training.batch,
            seconds=round(self.seconds, 1),
            seed=self.training.seed,
            commit=commit(),
            errors={str(k): Errors(test[i : i + 1]).summary() for i, k in enumerate(network.settings.modes or ("all",))},
        )
        if name == "relax" and card.target == "full":
            card = card.model_copy(update={"damped_from": self._least_damping(network, card)})
        save_weights(path, network, card)
        draw_curve(self.folder)

    def _least_damping(self, network: LearnedMap, card: Card) -> int:
        def relax(choice: int) -> Relax:
            part = Loaded(network.requires_grad_(False), card.model_copy(update={"damped_from": choice}))
            return LearnedMaps({"relax": (part,)}).relax

        X = self.source.shapes(self.source.rows("val", STABLE_SHAPES, self.training.seed)).numpy()
        return least_damping(relax, X, self.pairs.dt)


def read_log(folder: Path) -> list[dict[str, Any]]:
    """Lines of a run's log."""
    path = folder / "log.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def draw_curve(folder: Path) -> None:
    """curve.png: validation errors against samples."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = read_log(folder)
    figure = Figure(figsize=(6, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, style in (("p95", ":"), ("mean", "--"), ("median", "-")):
        axes.loglog([line["samples"] for line in lines], [line[name] for line in lines], style, color="tab:blue", label=name)
    axes.set(xlabel="samples", ylabel="relative L2 error, validation runs", title=folder.name)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(folder / "curve.png", dpi=130)
