"""Changes of a vehicle: which method adapts to them, and whether adaptation ever does harm."""
