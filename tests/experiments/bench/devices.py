"""Where rows in these tests were made."""

HERE = {"device": {"platform": "cpu", "kind": "a", "count": 1}}
ELSEWHERE = {"device": {"platform": "gpu", "kind": "b", "count": 1}}
