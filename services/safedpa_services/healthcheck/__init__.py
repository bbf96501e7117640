"""The health check: does one service of a fleet make progress, as heard on the bus?"""
