"""Show a policy, or record a controller: films, MuJoCo's viewer, a page in the browser."""
