"""A saved policy acting: state by state, in pictures, as a film or in a viewer."""
