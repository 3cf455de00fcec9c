"""`modelDescription.xml` of a driver's unit: variables, units, and what the unit can do."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

IDENTIFIER = "cfx_driver"
"""Name of the unit's library."""

STARTS = {"ego_speed": 10.0, "leader_speed": 10.0, "gap": 30.0}
"""What inputs are until they are set, as in `unit.c`; 0 where nothing is said."""

OUTPUTS = {
    "next_speed": ("m/s", "speed of the vehicle at the end of the step"),
    "acceleration": ("m/s2", "mean acceleration of the vehicle until then"),
}

_BASE_UNITS = {
    "s": {"s": 1},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
}
"""Units that FMI is told of; the description of a variable in another one says what it is."""


def description_of(
    signals: Mapping[str, tuple[str, str]], dt: float, token: str, about: str, is_random: bool
) -> bytes:
    """Returns the description.

    Args:
        signals: unit and meaning of each input, in order.
        dt: of the driver's step, s.
        token: that belongs to this unit alone.
        about: what it is, in words.
        is_random: whether the driver leaves something to chance, and so has a seed.
    """
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName="CfxDriver",
        instantiationToken=token,
        description=about,
        author="cfx",
        license="MIT",
        generationTool="cfx",
    )
    ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=IDENTIFIER,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    units = ET.SubElement(root, "UnitDefinitions")
    for name, powers in _BASE_UNITS.items():
        unit = ET.SubElement(units, "Unit", name=name)
        base = ET.SubElement(unit, "BaseUnit")
        for name_of_base, power in powers.items():
            base.set(name_of_base, str(power))
    categories = ET.SubElement(root, "LogCategories")
    for category in ("logStatusError", "logStatusDiscard"):
        ET.SubElement(categories, "Category", name=category)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=f"{dt:g}")
    variables = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    _variable(variables, 0, "time", ("s", "simulated time"), "independent")
    for number, (name, signal) in enumerate(signals.items(), 1):
        start = f"{STARTS.get(name, 0.0):g}"
        _variable(variables, number, name, signal, "input", start=start)
    for number, (name, output) in enumerate(OUTPUTS.items(), len(signals) + 1):
        _variable(variables, number, name, output, "output", initial="calculated")
        ET.SubElement(structure, "Output", valueReference=str(number))
    for number in range(len(signals) + 1, len(signals) + 1 + len(OUTPUTS)):
        ET.SubElement(structure, "InitialUnknown", valueReference=str(number))
    if is_random:
        ET.SubElement(
            variables,
            "Int32",
            name="seed",
            valueReference=str(len(signals) + 1 + len(OUTPUTS)),
            causality="parameter",
            variability="fixed",
            start="0",
            description="of what the driver leaves to chance",
        )
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root) + b"\n"


def build_description() -> bytes:
    """Returns `sources/buildDescription.xml`: how importers compile the unit for their machine."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=IDENTIFIER)
    files = ET.SubElement(build, "SourceFileSet", language="C17")
    ET.SubElement(files, "SourceFile", name="unit.c")
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root) + b"\n"


def _variable(
    variables: ET.Element,
    reference: int,
    name: str,
    signal: tuple[str, str],
    causality: str,
    **attributes: str,
) -> None:
    unit, meaning = signal
    variable = ET.SubElement(
        variables,
        "Float64",
        name=name,
        valueReference=str(reference),
        causality=causality,
        variability="continuous",
        description=meaning,
    )
    if unit in _BASE_UNITS:
        attributes["unit"] = unit
    for attribute, value in attributes.items():
        variable.set(attribute, value)
