"""The pneumatic drive and its parts."""
