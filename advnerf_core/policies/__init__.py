"""Policies of any origin behind one contract: modules with an adapter, exported programs, ONNX files, our own files."""
