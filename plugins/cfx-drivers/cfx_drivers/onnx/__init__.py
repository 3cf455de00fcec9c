"""cfx's drivers as ONNX files: `cfx export --to onnx`."""
