"""Reading and writing posed images: data sets, transforms.json, lenses, videos.

Files have OpenGL camera axes and possibly lens distortion, masks and transparency (see `transforms`); in memory everything has OpenCV axes
and ideal pinholes with pixel centres at +0.5 (see `views` and `lens`).
"""
