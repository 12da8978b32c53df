"""A simulation as an OpenFOAM case folder."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown import foam, jet
from seal_gym.sealant.laydown import mesh as meshes
from seal_gym.sealant.laydown.config import FluidCfg, GridCfg, LaydownCfg
from seal_gym.sealant.laydown.foam import Entry, dictionary, header
from seal_gym.sealant.laydown.mesh import Mesh

FLUID = "sealant"
_AIR_VISCOSITY_M2PS = 1.48e-5
_AIR_DENSITY_KGPM3 = 1.2
_OPEN: dict[str, Entry] = {"type": "inletOutlet", "inletValue": "uniform 0", "value": "uniform 0"}


def build_mesh(cfg: LaydownCfg) -> Mesh:
    """The mesh that a simulation needs.

    Args:
        cfg: The simulation.

    Returns:
        A mesh around all that the jet meets.

    Raises:
        LaydownError: If a part of the jet does not come down on the substrate.
    """
    part, grid = cfg.part, cfg.grid
    place = jet.landings(cfg)[2][:, :2]
    landings, margin = cKDTree(place), grid.margin_m

    def near(x: Array, y: Array) -> NDArray[np.bool_]:
        away, _ = landings.query(np.stack((x, y), -1), distance_upper_bound=margin)
        return np.asarray(np.isfinite(away))

    return meshes.build(
        part, place.min(0) - margin, place.max(0) + margin, grid.clearance_m, grid.cell_m, near
    )


def transport(fluid: FluidCfg) -> dict[str, Entry]:
    """``transportProperties``: kinematic, as OpenFOAM has it.

    Args:
        fluid: The sealant.

    Returns:
        Entries.
    """
    material = fluid.sealant
    rho = material.density_kg_m3
    model: dict[str, Entry] = {
        "nu0": fluid.viscosity_cap_pas / rho,
        "tau0": material.yield_stress_pa / rho,
        "k": material.consistency_pa_sn / rho,
        "n": float(material.flow_index),
    }
    sealant: dict[str, Entry] = {
        "transportModel": "HerschelBulkley",
        "HerschelBulkleyCoeffs": model,
        "rho": float(rho),
    }
    air: dict[str, Entry] = {
        "transportModel": "Newtonian",
        "nu": _AIR_VISCOSITY_M2PS,
        "rho": _AIR_DENSITY_KGPM3,
    }
    return {"phases": f"({FLUID} air)", FLUID: sealant, "air": air, "sigma": float(fluid.surface_tension_npm)}


def control(grid: GridCfg, end_s: float) -> dict[str, Entry]:
    """``controlDict``.

    Args:
        grid: Solver and time step.
        end_s: Simulated time [s].

    Returns:
        Entries.
    """
    return {
        "application": grid.solver,
        "startFrom": "startTime",
        "startTime": 0,
        "stopAt": "endTime",
        "endTime": end_s,
        "deltaT": 1e-5,
        "writeControl": "adjustableRunTime",
        "writeInterval": end_s,
        "writeFormat": "ascii",
        "writePrecision": 9,
        "timePrecision": 9,
        "adjustTimeStep": "yes",
        "maxCo": float(grid.courant),
        "maxAlphaCo": float(grid.courant),
        "maxDeltaT": 0.5 * grid.inlet_dt_s,
        "runTimeModifiable": "no",
    }


def schemes() -> dict[str, Entry]:
    """``fvSchemes``.

    Returns:
        Entries.
    """
    return {
        "ddtSchemes": {"default": "Euler"},
        "gradSchemes": {"default": "Gauss linear"},
        "divSchemes": {
            "div(rhoPhi,U)": "Gauss linearUpwind grad(U)",
            "div(phi,alpha)": "Gauss vanLeer",
            "div(phirb,alpha)": "Gauss linear",
            "div(((rho*nuEff)*dev2(T(grad(U)))))": "Gauss linear",
        },
        "laplacianSchemes": {"default": "Gauss linear orthogonal"},
        "interpolationSchemes": {"default": "linear"},
        "snGradSchemes": {"default": "orthogonal"},
        "fluxRequired": {"default": "no", "p_rgh": "", "pcorr": "", f"alpha.{FLUID}": ""},
    }


def solution() -> dict[str, Entry]:
    """``fvSolution``.

    No momentum predictor: the viscous term is some hundred times stiffer than the step. What two pressure
    corrections leave of a predictor's velocity keeps a bead at rest stirring at 0.1 m/s and lets it creep
    outwards for as long as one waits; with six, or without a predictor, it comes to rest.

    Returns:
        Entries.
    """
    alpha: dict[str, Entry] = {
        "nAlphaCorr": 1,
        "nAlphaSubCycles": 1,
        "cAlpha": 1,
        "MULESCorr": "yes",
        "nLimiterIter": 5,
        "solver": "smoothSolver",
        "smoother": "symGaussSeidel",
        "tolerance": 1e-10,
        "relTol": 0,
        # of interIsoFoam
        "isoFaceTol": 1e-6,
        "surfCellTol": 1e-6,
        "nAlphaBounds": 3,
        "snapTol": 1e-12,
        "clip": "false",
    }
    pressure: dict[str, Entry] = {
        "solver": "PCG",
        "preconditioner": "DIC",
        "tolerance": 1e-6,
        "relTol": 0.02,
    }
    return {
        "solvers": {
            f'"alpha.{FLUID}.*"': alpha,
            '"pcorr.*"': pressure | {"relTol": 0, "tolerance": 1e-8},
            "p_rgh": pressure,
            "p_rghFinal": pressure | {"relTol": 0, "tolerance": 1e-8},
            '"U.*"': {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": 1e-8, "relTol": 1e-3},
        },
        "PIMPLE": {
            "momentumPredictor": "no",
            "nOuterCorrectors": 1,
            "nCorrectors": 3,
            "nNonOrthogonalCorrectors": 0,
        },
        "relaxationFactors": {"equations": {'".*"': 1}},
    }


def _field(name: str, dimensions: str, value: str, patches: dict[str, Entry]) -> str:
    cls = "volVectorField" if name == "U" else "volScalarField"
    entries: dict[str, Entry] = {
        "dimensions": dimensions,
        "internalField": f"uniform {value}",
        "boundaryField": patches,
    }
    return header(cls, name) + dictionary(entries)


def _write_mesh(mesh: Mesh, folder: Path) -> None:
    folder.mkdir(parents=True)
    faces = "\n".join("4({} {} {} {})".format(*f) for f in mesh.faces.tolist())
    (folder / "points").write_text(header("vectorField", "points") + foam.values(mesh.points))
    (folder / "faces").write_text(header("faceList", "faces") + f"{len(mesh.faces)}\n(\n{faces}\n)\n")
    for name, ids in (("owner", mesh.owner), ("neighbour", mesh.neighbour)):
        body = "\n".join(map(str, ids.tolist()))
        (folder / name).write_text(header("labelList", name) + f"{len(ids)}\n(\n{body}\n)\n")
    kinds = {"top": "patch", "sides": "patch", "substrate": "wall"}
    entries: dict[str, Entry] = {
        name: {"type": kinds[name], "nFaces": count, "startFace": first}
        for name, (first, count) in mesh.patches.items()
    }
    (folder / "boundary").write_text(
        header("polyBoundaryMesh", "boundary") + f"{len(entries)}\n(\n{dictionary(entries, 1)})\n"
    )


def _write_inflow(flow: jet.Inflow, centres: Array, folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "points").write_text(foam.values(centres))
    for time, velocity in zip(flow.times_s, flow.velocities, strict=True):
        at = folder / f"{time:.9g}"
        at.mkdir()
        (at / "U").write_text(foam.values(velocity))


def _boundaries() -> dict[str, tuple[str, str, dict[str, Entry]]]:
    """Dimensions, initial value and boundary conditions of each field."""
    free: Entry = {"type": "pressureInletOutletVelocity", "value": "uniform (0 0 0)"}
    air: Entry = {"type": "totalPressure", "p0": "uniform 0", "value": "uniform 0"}
    given: Entry = {"type": "fixedFluxPressure", "value": "uniform 0"}
    jets: Entry = {
        "type": "timeVaryingMappedFixedValue",
        "mapMethod": "nearest",
        "setAverage": "off",
        "value": "uniform (0 0 0)",
    }
    alpha = f"alpha.{FLUID}"
    velocity: dict[str, Entry] = {"top": free, "sides": free, "substrate": jets}
    # To the fluid the wall is full of sealant: what comes out of it is, and what lies on it sticks to it.
    fraction: dict[str, Entry] = {
        "top": _OPEN,
        "sides": _OPEN,
        "substrate": {"type": "fixedValue", "value": "uniform 1"},
    }
    pressure: dict[str, Entry] = {"top": air, "sides": air, "substrate": given}
    return {
        "U": ("[0 1 -1 0 0 0 0]", "(0 0 0)", velocity),
        alpha: ("[0 0 0 0 0 0 0]", "0", fraction),
        "p_rgh": ("[1 -1 -2 0 0 0 0]", "0", pressure),
    }


def write(cfg: LaydownCfg, folder: Path) -> tuple[Mesh, jet.Inflow, float]:
    """Writes a case folder.

    Args:
        cfg: The simulation.
        folder: Must not exist.

    Returns:
        The mesh, what flows in, and the simulated time [s].

    Raises:
        LaydownError: If a part of the jet does not come down on the substrate.
    """
    mesh = build_mesh(cfg)
    flow = jet.inflow(cfg, mesh)
    end_s = round(float(flow.times_s[-1]) + cfg.grid.settle_s, 9)
    _write_mesh(mesh, folder / "constant" / "polyMesh")
    data = folder / "constant" / "boundaryData" / "substrate"
    _write_inflow(flow, mesh.faces_of("substrate")[0], data)
    gravity: dict[str, Entry] = {
        "dimensions": "[0 1 -2 0 0 0 0]",
        "value": "({:.9g} {:.9g} {:.9g})".format(*cfg.gravity_mps2),
    }
    dictionaries: dict[str, tuple[str, dict[str, Entry]]] = {
        "constant/transportProperties": ("dictionary", transport(cfg.fluid)),
        "constant/turbulenceProperties": ("dictionary", {"simulationType": "laminar"}),
        "constant/g": ("uniformDimensionedVectorField", gravity),
        "system/controlDict": ("dictionary", control(cfg.grid, end_s)),
        "system/fvSchemes": ("dictionary", schemes()),
        "system/fvSolution": ("dictionary", solution()),
    }
    for path, (cls, entries) in dictionaries.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(header(cls, file.name) + dictionary(entries))
    (folder / "0").mkdir()
    for name, (dimensions, value, patches) in _boundaries().items():
        (folder / "0" / name).write_text(_field(name, dimensions, value, patches))
    return mesh, flow, end_s
