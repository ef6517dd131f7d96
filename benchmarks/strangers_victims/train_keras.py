"""A steering network in plain Keras, as somebody trains one who has never heard of this project: ``python train_keras.py DATA.npz POLICY.onnx``."""

import os
import sys

os.environ.setdefault("KERAS_BACKEND", "torch")

import keras
import numpy as np

data = np.load(sys.argv[1])
keras.utils.set_random_seed(0)
images, steering = data["images"].astype("float32") / 255.0, data["steering"].astype("float32")
layers = keras.layers
network = keras.Sequential([keras.Input(images.shape[1:], name="image")])
for filters in (16, 24, 32, 32):
    network.add(layers.Conv2D(filters, 3, strides=2, padding="same", activation="relu"))
for layer in (layers.Flatten(), layers.Dense(64, activation="relu"), layers.Dense(1, activation="tanh")):
    network.add(layer)
network.compile(optimizer=keras.optimizers.Adam(1e-3), loss="mse")
network.fit(images, steering, batch_size=64, epochs=25, verbose=2)
print(f"a spread of {steering.var():.5f}")
network.export(sys.argv[2], format="onnx", verbose=False)
