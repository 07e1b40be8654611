-- A database of JuPedSim: two people in a room with an obstacle.
CREATE TABLE trajectory_data (frame, id, pos_x, pos_y, ori_x, ori_y);
CREATE TABLE metadata (key TEXT PRIMARY KEY, value TEXT);
CREATE TABLE geometry (hash INTEGER, wkt TEXT);
INSERT INTO metadata VALUES ('version', '2'), ('fps', '10.0');
WITH RECURSIVE frames(k) AS (SELECT 0 UNION ALL SELECT k + 1 FROM frames WHERE k < 20)
INSERT INTO trajectory_data SELECT k, n, 1 + 0.12 * k, n, 1.0, 0.0 FROM frames, (SELECT 1 AS n UNION SELECT 2);
INSERT INTO geometry
VALUES (1, 'POLYGON ((0 0, 20 0, 20 4, 0 4, 0 0), (4 1, 5 1, 5 2, 4 2, 4 1))');
