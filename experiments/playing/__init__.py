"""Playing a saved policy: episodes state by state, pictures, films and MuJoCo's viewer."""
