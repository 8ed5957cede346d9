"""Networks in other runtimes: ONNX files with the answer in the graph, int8, ONNX Runtime and OpenVINO."""
