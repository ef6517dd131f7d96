import json

import numpy as np
import pytest

from advnerf_core.scene.dataset import DatasetError, load_transforms


@pytest.mark.parametrize("lens", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_lens_that_would_be_misread_is_refused(tmp_path, lens):
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({**lens, "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]}))
    with pytest.raises(DatasetError, match=r"expected camera_model .*OPENCV.*undistort the images first"):
        load_transforms(file)
