"""Training of learned models on batched simulators, in the phases of the SafeDPA paper.

Read ``pipeline`` first: it runs the stages of a robot by the settings of ``configuration``. The stages live in
``phases`` (1a: mu, f and g; 1b: policy; 2: history encoder phi; 3: tuning on real data). They share ``environments``
(batched simulator and policy tasks), ``data`` (transitions and drives), ``networks`` (torch modules and their errors)
and ``export`` (weights files and ONNX). ``optimisation`` holds what they share of torch, ``progress`` the progress
callback and the training record.
"""
