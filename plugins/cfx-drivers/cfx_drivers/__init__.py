"""The drivers of cfx in other simulators: as ONNX files, FMI units and Gymnasium environments."""
