"""The card of an exported driver, Markdown: what goes in and out, and how it agrees with cfx."""

from __future__ import annotations

import onnx


def card(graph: onnx.ModelProto, run: str, size: int, difference: float) -> str:
    """Returns the card of a graph.

    Args:
        graph: with its metadata.
        run: where the policy comes from.
        size: of the file, bytes.
        difference: of speeds from cfx's, m/s.
    """
    about = {item.key: item.value for item in graph.metadata_props}
    lines = [
        f"# {run}",
        "",
        f"One step of {about['cfx.dt']} of any number of drivers: policy, head, driving model"
        f" ({about['cfx.model']}) and limits of acceleration. ONNX opset"
        f" {graph.opset_import[0].version}, {size / 1000:.0f} kB, made by cfx"
        f" {about['cfx.version']}. After a step its speeds differ from cfx's by"
        f" {difference:.1g} m/s at most, in a platoon behind a leader that brakes and recovers.",
        "",
        f"Parameters: {about['cfx.parameters']}.",
        "",
        "Each step gives `next_NAME` of what is remembered, which goes in as `NAME` in the next"
        " step. For a driver who begins all of it is 0. `drivers` is the number of vehicles.",
        "",
        "| tensor | type, shape | meaning [unit] |",
        "| --- | --- | --- |",
    ]
    for tensor in (*graph.graph.input, *graph.graph.output):
        kind = tensor.type.tensor_type
        shape = ", ".join(item.dim_param or str(item.dim_value) for item in kind.shape.dim)
        name = onnx.TensorProto.DataType.Name(kind.elem_type).lower()
        lines.append(f"| `{tensor.name}` | {name} ({shape}) | {tensor.doc_string} |")
    return "\n".join([*lines, ""])
