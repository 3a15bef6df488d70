"""Small data sets of each family, and runs in shear as a batch, for the tests of the harvest."""

from math import pi

import numpy as np

from biem.scene.tables import validated
from datagen.batch import Batch
from datagen.config import Dataset
from datagen.flows import Flows, Start
from datagen.harvest import harvest, harvest_tasks

R = 0.128314817  # of reduced area 0.65
AREA = 0.65 / (4 * pi)
RELAXATION = {"flow": "relaxation", "runs": 3, "dt": 0.05, "horizon": 0.2, "shapes": 2}
SHEAR = {"flow": "shear", "runs": 3, "capillary": (2.0, 4.0), "dt": 0.1, "horizon": 0.4, "shapes": 2}
EXTENSIONAL = SHEAR | {"flow": "extensional"}
POISEUILLE = SHEAR | {"flow": "poiseuille"}
SUSPENSION = {"flow": "suspension", "initial": "equilibrium", "runs": 2, "capillary": (2.0, 8.0), "dt": 0.1, "horizon": 0.4, "shapes": 2}
SUSPENSION |= {"vesicles": 3, "radius": 1.2, "obstacles": 1}


def dataset(*families, points=32, tolerance=1e-3, device="cpu", seed=0):
    simulation = {"points": points, "tolerance": tolerance, "device": device}
    return validated(Dataset, {"name": "test", "seed": seed, "harvest": list(families), "simulation": simulation})


def first_task(config):
    return harvest(config, harvest_tasks(config)[0])


def shear_batch(capillary, ladder=(32,), tolerance=1e-3):
    """Runs of these capillary numbers in shear, and their rates."""
    flows = Flows.of("shear", [Start(np.empty(0), c, 1.0) for c in capillary], 0.65)
    return Batch(flows.velocity, AREA, ladder, tolerance), flows.rate
