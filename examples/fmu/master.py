"""A master in Python for a unit for co-simulation of maxq: the flight code of pd_law.py flies the vehicle in it.

    pip install fmpy 'maxq[fmu]'
    simrun export nominal --fmu rocket.fmu
    python master.py rocket.fmu runs/fmu

The flight equals, to the last bit, that of simrun with this code in its own process:

    simrun nominal --set vehicle.computer.law=external --set vehicle.computer.python=pd_law.py:Autopilot
"""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import fmpy
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "flight_software"))
from pd_law import Autopilot

TRIPLES = ("angle_rad", "commanded_angle_rad", "rate_radps")


def fly(unit, log_folder=""):
    """Fly until the end of the experiment. Returns the number of steps and the inputs at the last sample."""
    description = fmpy.read_model_description(unit)
    experiment = description.defaultExperiment
    end_s, sample_s = float(experiment.stopTime), float(experiment.stepSize)
    of = {variable.name: variable.valueReference for variable in description.modelVariables}
    third = description.fmiVersion == "3.0"
    folder = fmpy.extract(unit)
    fmu = (FMU3Slave if third else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="vehicle",
    )
    get, put = (fmu.getFloat64, fmu.setFloat64) if third else (fmu.getReal, fmu.setReal)
    put_integer = fmu.setInt64 if third else fmu.setReal
    sensors = [f"{name}[{axis}]" for name in TRIPLES for axis in range(3)]
    try:
        fmu.instantiate()
        if not third:
            fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.setString([of["log_folder"]], [log_folder])
        fmu.exitInitializationMode()
        autopilot = Autopilot(SimpleNamespace(sample_ns=round(1e9 * sample_s)))
        steps = round(end_s / sample_s)
        for step in range(steps):
            fmu.doStep(currentCommunicationPoint=step * sample_s, communicationStepSize=sample_s)
            values = get([of[name] for name in sensors])
            given = {name: values[3 * k : 3 * k + 3] for k, name in enumerate(TRIPLES)}
            inputs = SimpleNamespace(time_s=get([of["time_s"]])[0], **given)
            outputs = autopilot.step(inputs)
            put([of["gimbal_rad[0]"], of["gimbal_rad[1]"]], outputs["gimbal_rad"])
            put_integer([of["roll_thruster"]], [outputs["roll_thruster"]])
        fmu.terminate()
        return steps, inputs
    finally:
        fmu.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    steps, last = fly(*sys.argv[1:])
    print(f"{steps} steps; attitude at {last.time_s:.3f} s: {last.angle_rad}")
