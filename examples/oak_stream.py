"""Upsample the frames of an OAK camera as they come; Ctrl-C ends it.

pip install "depthai>=3"; python examples/oak_stream.py
"""

import depthai as dai
import numpy as np

import dsr

upsampler = dsr.Upsampler()
with dai.Pipeline() as pipeline:
    color, left, right = (
        pipeline.create(dai.node.Camera).build(socket).requestOutput((640, 400), kind, enableUndistortion=undistort)
        for socket, kind, undistort in (
            (dai.CameraBoardSocket.CAM_A, dai.ImgFrame.Type.RGB888i, True),
            (dai.CameraBoardSocket.CAM_B, None, None),
            (dai.CameraBoardSocket.CAM_C, None, None),
        )
    )
    stereo = pipeline.create(dai.node.StereoDepth).build(left, right)
    color.link(stereo.inputAlignTo)  # depth in the pixels of the photo
    sync = pipeline.create(dai.node.Sync)
    color.link(sync.inputs["color"])
    stereo.depth.link(sync.inputs["depth"])
    queue = sync.out.createOutputQueue()
    pipeline.start()
    while pipeline.isRunning():
        pair = queue.get()
        photo, stored = pair["color"].getCvFrame()[..., ::-1], pair["depth"].getFrame()  # BGR; millimetres, 0 in holes
        matrix = pair["color"].getTransformation().getIntrinsicMatrix()
        camera = dsr.Camera.from_matrix(matrix, photo.shape[1], photo.shape[0])
        surface = upsampler(photo, stored, camera, unit="mm")
        print(f"{np.nanmedian(surface.depth):.3f} +- {np.nanmedian(surface.depth_error):.4f} m")
