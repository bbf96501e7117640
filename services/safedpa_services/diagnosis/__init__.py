"""The diagnosis service: watches over the models of a fleet, searches for what they lack, changes them."""
