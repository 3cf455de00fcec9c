"""`modelDescription.xml` of a driver's OSMP unit: FMI 2.0, with OSMP's variables and annotations.

OSMP 1.6.0: https://opensimulationinterface.github.io/osi-antora-generator/
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

from cfx_drivers.fmi.description import IDENTIFIER

OSMP_VERSION, OSI_VERSION = "1.6.0", "3.8.0"
"""Of the specification; of the messages, as in `scene.h`."""

_NAMESPACE = "http://xsd.pmsf.net/OSISensorModelPackaging"
_TOOL = "net.pmsf.osmp"

_ROLES = ("base.lo", "base.hi", "size")

_IS_PARAMETER = {"causality": "parameter", "variability": "fixed", "initial": "exact"}


def description_of(dt: float, token: str, about: str, is_random: bool, main: str) -> bytes:
    """Returns the description; variables are in the order of their references in `unit.c`.

    Args:
        dt: of the driver's step, s.
        token: that belongs to this unit alone.
        about: what it is, in words.
        is_random: whether the driver leaves something to chance, and so has a seed.
        main: the source file that is compiled.
    """
    ET.register_namespace("osmp", _NAMESPACE)
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName="CfxDriver",
        guid=token,
        description=about,
        author="cfx",
        license="MIT",
        generationTool="cfx",
        variableNamingConvention="structured",
    )
    simulation = ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=IDENTIFIER,
        canHandleVariableCommunicationStepSize="true",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    ET.SubElement(ET.SubElement(simulation, "SourceFiles"), "File", name=main)
    categories = ET.SubElement(root, "LogCategories")
    for category in ("logStatusError", "logStatusDiscard"):
        ET.SubElement(categories, "Category", name=category)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=f"{dt:g}")
    annotation = _annotation(ET.SubElement(root, "VendorAnnotations"), "osmp")
    annotation.set("version", OSMP_VERSION)
    annotation.set("osi-version", OSI_VERSION)

    variables = ET.SubElement(root, "ModelVariables")
    is_input = {"causality": "input", "variability": "discrete"}
    _message(variables, "OSMPSensorViewIn", "SensorView", is_input)
    _message(variables, "OSMPGroundTruthInit", "GroundTruth", _IS_PARAMETER)
    vehicle = "id of the vehicle that is driven; -1: the host vehicle"
    _integer(variables, 6, "vehicle_id", -1, {**_IS_PARAMETER, "description": vehicle})
    if is_random:
        seed = "of what the driver leaves to chance"
        _integer(variables, 7, "seed", 0, {**_IS_PARAMETER, "description": seed})
    is_output = {"causality": "output", "variability": "discrete", "initial": "exact"}
    first = len(variables) + 1
    _message(variables, "OSMPTrafficUpdateOut", "TrafficUpdate", is_output, 8)
    outputs = ET.SubElement(ET.SubElement(root, "ModelStructure"), "Outputs")
    for index in range(first, len(variables) + 1):
        ET.SubElement(outputs, "Unknown", index=str(index))
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root) + b"\n"


def _message(
    variables: ET.Element,
    name: str,
    message: str,
    attributes: dict[str, str],
    reference: int | None = None,
) -> None:
    """Adds a binary variable: the address of a message's bytes in two halves, and their number."""
    first = len(variables) if reference is None else reference
    kind = f"application/x-open-simulation-interface; type={message}; version={OSI_VERSION}"
    for number, role in enumerate(_ROLES):
        variable = _integer(variables, first + number, f"{name}.{role}", 0, attributes)
        annotation = _annotation(ET.SubElement(variable, "Annotations"), "osmp-binary-variable")
        annotation.set("name", name)
        annotation.set("role", role)
        annotation.set("mime-type", kind)


def _integer(
    variables: ET.Element, reference: int, name: str, start: int, attributes: dict[str, str]
) -> ET.Element:
    variable = ET.SubElement(variables, "ScalarVariable", name=name, valueReference=str(reference))
    for attribute, value in attributes.items():
        variable.set(attribute, value)
    ET.SubElement(variable, "Integer", start=str(start))
    return variable


def _annotation(parent: ET.Element, name: str) -> ET.Element:
    tool = ET.SubElement(parent, "Tool", name=_TOOL)
    return ET.SubElement(tool, f"{{{_NAMESPACE}}}{name}")
