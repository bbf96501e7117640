"""The stand-in of the differential drive."""
