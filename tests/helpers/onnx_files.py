"""A network in an ONNX file, written node by node, and the same network computed by numpy."""

import numpy as np
import onnx


def layers(inputs, outputs):
    rng = np.random.default_rng(1)
    sizes = [(inputs, 16), (16, outputs)]
    return [
        (rng.normal(size=size).astype(np.float32), rng.normal(size=size[1]).astype(np.float32) * 0.1) for size in sizes
    ]


def saved_network(path, inputs, outputs, shape):
    """Return an ONNX model with one hidden layer of ReLUs and an input of the given shape."""
    helper, (first, second) = onnx.helper, layers(inputs, outputs)
    nodes = [
        helper.make_node("Flatten", ["seen"], ["flat"]),
        helper.make_node("Gemm", ["flat", "w0", "b0"], ["hidden"]),
        helper.make_node("Relu", ["hidden"], ["active"]),
        helper.make_node("Gemm", ["active", "w1", "b1"], ["values"]),
    ]
    arrays = zip(("w0", "b0", "w1", "b1"), (*first, *second), strict=True)
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("seen", onnx.TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("values", onnx.TensorProto.FLOAT, [shape[0], outputs])],
        [onnx.numpy_helper.from_array(array, name) for name, array in arrays],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def computed(observation, outputs):
    (w0, b0), (w1, b1) = layers(observation.size, outputs)
    return np.maximum(observation.ravel() @ w0 + b0, 0) @ w1 + b1
