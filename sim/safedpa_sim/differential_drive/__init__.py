"""The simulated stand-in of the differential drive."""
