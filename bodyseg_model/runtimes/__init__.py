"""Networks in other runtimes: ONNX files with the answer in the graph, ONNX Runtime and OpenVINO."""
