"""A two-stage OpenRocket design with each kind of component, its motors, and its masses in closed form."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable
from pathlib import Path

RHO = 1000.0
NOSE_m, TUBE_m, CONE_m, LOWER_m, R, W, RADIUS = 0.3, 0.6, 0.1, 0.4, 0.04, 0.002, 0.05
MOTOR = """\
; a test motor
{name} 38 200 0 {propellant} {total} Test
0.05 {peak}
1.0 {peak}
1.2 0.0
"""
BULK = f'<material type="bulk" density="{RHO}">Fiberglass</material>'


def xml(upper: str = "", *, nose: str = "", lower: str = "", rocket: str = "") -> str:
    """Return the design with further elements in the upper tube, the nose, the lower tube, and the rocket."""
    cloth, cord = '<material type="surface" density="0.05"/>', '<material type="line" density="0.01"/>'
    fins = f"<fincount>4</fincount><thickness>0.003</thickness>{BULK}"
    at = '<axialoffset method="{}">{}</axialoffset>'.format
    place = at("top", 0.05)
    inside = f"""
<trapezoidfinset><name>fins</name>{at("bottom", -0.01)}{fins}<crosssection>rounded</crosssection>
<rootchord>0.1</rootchord>
<tipchord>0.04</tipchord><sweeplength>0.05</sweeplength><height>0.06</height><tabheight>0.01</tabheight>
<tablength>0.05</tablength><tabposition relativeto="front">0.02</tabposition></trapezoidfinset>
<innertube><name>mount</name>{at("bottom", 0.0)}{BULK}<length>0.25</length><outerradius>0.021</outerradius>
<thickness>0.002</thickness><clusterconfiguration>single</clusterconfiguration><motormount>
<motor configid="one"><designation>M38-P</designation><diameter>0.038</diameter><length>0.2</length>
<delay>none</delay></motor>
<overhang>0.005</overhang></motormount><subcomponents><engineblock><name>block</name>{at("top", 0.01)}{BULK}
<length>0.01</length><outerradius>auto</outerradius><thickness>0.004</thickness></engineblock></subcomponents>
</innertube>
<centeringring><name>rings</name>{at("bottom", -0.1)}{BULK}<length>0.005</length><outerradius>auto</outerradius>
<innerradius>auto</innerradius><instancecount>2</instancecount><instanceseparation>0.05</instanceseparation>
</centeringring>
<bulkhead><name>bulkhead</name>{at("middle", 0.0)}{BULK}<length>0.01</length><outerradius>auto</outerradius>
</bulkhead>
<shockcord><name>cord</name>{place}<packedlength>0.04</packedlength><cordlength>3.0</cordlength>{cord}</shockcord>
<parachute><name>parachute</name>{place}<packedlength>0.06</packedlength><diameter>0.8</diameter>{cloth}
<linecount>8</linecount><linelength>1.0</linelength>{cord.replace("material", "linematerial")}</parachute>
<streamer><name>streamer</name>{place}<packedlength>0.02</packedlength><striplength>1.0</striplength>
<stripwidth>0.1</stripwidth>{cloth}</streamer>
<masscomponent><name>payload</name>{at("top", 0.2)}<packedlength>0.1</packedlength><packedradius>0.03</packedradius>
<mass>0.4</mass></masscomponent>
<launchlug><name>lug</name>{at("top", 0.3)}{BULK}<radius>0.005</radius><length>0.03</length>
<thickness>0.001</thickness></launchlug>
<railbutton><name>button</name>{at("top", 0.4)}{BULK}<outerdiameter>0.01</outerdiameter>
<innerdiameter>0.006</innerdiameter>
<height>0.008</height><baseheight>0.002</baseheight><flangeheight>0.002</flangeheight>
<screwmass>0.003</screwmass></railbutton>
{upper}"""
    below = f"""
<ellipticalfinset><name>round fins</name>{at("bottom", 0.0)}{fins}<rootchord>0.1</rootchord>
<height>0.08</height></ellipticalfinset>
<freeformfinset><name>free fins</name>{at("top", 0.0)}{fins}<finpoints><point x="0" y="0"/><point x="0.05" y="0.06"/>
<point x="0.09" y="0.06"/><point x="0.1" y="0"/></finpoints></freeformfinset>
<tubefinset><name>tube fins</name>{at("top", 0.15)}{BULK}<fincount>4</fincount><length>0.05</length>
<radius>0.01</radius>
<thickness>0.001</thickness></tubefinset>
<tubecoupler><name>coupler</name>{at("top", -0.05)}{BULK}<length>0.1</length><outerradius>auto</outerradius>
<thickness>0.002</thickness></tubecoupler>{lower}"""
    mount = """<motormount><ignitionevent>automatic</ignitionevent><ignitiondelay>0.5</ignitiondelay>
<motor configid="one"><designation>N38</designation><diameter>0.038</diameter><length>0.2</length>
<delay>1.0</delay></motor>
<overhang>0.0</overhang></motormount>"""
    return f"""<?xml version="1.0" encoding="utf-8"?>
<openrocket version="1.10" creator="a test"><rocket><name>Every component</name>
<motorconfiguration configid="one" default="true"/><motorconfiguration configid="two"/>{rocket}<subcomponents>
<stage><name>Upper stage</name><subcomponents>
<nosecone><name>nose</name>{BULK}<length>{NOSE_m}</length><thickness>{W}</thickness><shape>conical</shape>
<aftradius>{R}</aftradius><aftshoulderlength>0.05</aftshoulderlength><aftshoulderradius>0.038</aftshoulderradius>
<aftshoulderthickness>0.002</aftshoulderthickness><aftshouldercapped>true</aftshouldercapped>{nose}</nosecone>
<bodytube><name>tube</name>{BULK}<length>{TUBE_m}</length><thickness>{W}</thickness><radius>auto 0.04</radius>
<subcomponents>{inside}</subcomponents></bodytube></subcomponents></stage>
<stage><name>Lower stage</name><subcomponents>
<transition><name>skirt</name>{BULK}<length>{CONE_m}</length><thickness>filled</thickness><shape>conical</shape>
<foreradius>auto</foreradius><aftradius>{RADIUS}</aftradius></transition>
<bodytube><name>booster</name>{BULK}<length>{LOWER_m}</length><thickness>{W}</thickness><radius>auto</radius>{mount}
<subcomponents>{below}</subcomponents></bodytube></subcomponents></stage></subcomponents></rocket>
<simulations><simulation><name>first</name><conditions><configid>one</configid><launchrodlength>2.5</launchrodlength>
<launchrodangle>5.0</launchrodangle><launchroddirection>80.0</launchroddirection>
<launchaltitude>120.0</launchaltitude>
<launchlatitude>46.5</launchlatitude><launchlongitude>7.0</launchlongitude></conditions></simulation></simulations>
</openrocket>"""


def closed_forms() -> list[tuple[str, float, float]]:
    """Return the name, mass (kg) and station (m) of each mass without motors, in the order of the design."""
    slope = math.sqrt(1.0 + (R / NOSE_m) ** 2)
    inner, tip = R - W * slope, W * slope * NOSE_m / R
    cone = [
        (math.pi * R**2 * NOSE_m / 3.0, 0.75 * NOSE_m),
        (-math.pi * inner**2 * (NOSE_m - tip) / 3.0, tip + 0.75 * (NOSE_m - tip)),
        (math.pi * (0.038**2 - 0.036**2) * 0.05, NOSE_m + 0.025),
        (math.pi * 0.036**2 * 0.002, NOSE_m + 0.049),
    ]

    def ring(name: str, outer: float, inner: float, length: float, front: float) -> tuple[str, float, float]:
        return name, RHO * math.pi * (outer**2 - inner**2) * length, front + 0.5 * length

    top, end = NOSE_m, NOSE_m + TUBE_m
    bottom = end + CONE_m
    mount, fin = end - 0.25, end - 0.1 - 0.01
    trapezoid = 0.5 * (0.1 + 0.04) * 0.06
    centre = 0.05 * (0.1 + 2.0 * 0.04) / (3.0 * 0.14) + (0.1**2 + 0.1 * 0.04 + 0.04**2) / (3.0 * 0.14)
    freeform = 0.5 * (0.1 + 0.04) * 0.06  # the trapezoid again
    skirt = R**2 + R * RADIUS + RADIUS**2
    return [
        ("nose", RHO * sum(v for v, _ in cone), sum(v * x for v, x in cone) / sum(v for v, _ in cone)),
        ring("tube", R, R - W, TUBE_m, top),
        ("fins", 4 * 0.99 * RHO * trapezoid * 0.003, fin + centre),
        ("fins, tabs", 4 * RHO * 0.01 * 0.05 * 0.003, fin + 0.02 + 0.025),
        ring("mount", 0.021, 0.019, 0.25, mount),
        ring("block", 0.019, 0.015, 0.01, mount + 0.01),
        ring("rings", 0.038, 0.021, 0.005, end - 0.005 - 0.1),
        ring("rings", 0.038, 0.021, 0.005, end - 0.005 - 0.05),
        ring("bulkhead", 0.038, 0.0, 0.01, top + 0.5 * (TUBE_m - 0.01)),
        ("cord", 0.03, top + 0.07),
        ("parachute", 0.05 * math.pi * 0.16 + 8 * 0.01, top + 0.08),
        ("streamer", 0.1 * 0.05, top + 0.06),
        ("payload", 0.4, top + 0.25),
        ring("lug", 0.005, 0.004, 0.03, top + 0.3),
        ("button", 0.003 + RHO * math.pi * (0.005**2 * 0.004 + 0.003**2 * 0.004), top + 0.4 + 0.005),
        (
            "skirt",
            RHO * math.pi * CONE_m * skirt / 3.0,
            end + CONE_m * (R**2 + 2 * R * RADIUS + 3 * RADIUS**2) / (4 * skirt),
        ),
        ring("booster", RADIUS, RADIUS - W, LOWER_m, bottom),
        ("round fins", 4 * RHO * math.pi * 0.1 * 0.08 / 4.0 * 0.003, bottom + LOWER_m - 0.05),
        ("free fins", 4 * RHO * freeform * 0.003, bottom + centre),
        ("tube fins", 4 * RHO * math.pi * (0.01**2 - 0.009**2) * 0.05, bottom + 0.175),
        ring("coupler", 0.048, 0.046, 0.1, bottom - 0.05),
    ]


def zipped(text: str, name: str = "rocket.ork") -> bytes:
    """Return the content of a design file."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, text)
    return out.getvalue()


def write_design(folder: Path, text: str, motors: Iterable[str] = ("M38-P", "N38")) -> Path:
    """Write a design and the files of motors next to it; return the path of the design."""
    (folder / "rocket.ork").write_bytes(zipped(text))
    for name in motors:
        (folder / f"{name}.eng").write_text(MOTOR.format(name=name, propellant=0.2, total=0.35, peak=250.0))
    return folder / "rocket.ork"
