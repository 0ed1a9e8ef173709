/* SPDX-License-Identifier: MIT-0
   inside.h - what tests see of dist.h beyond its declarations

   Tests are linked with one translation of the library, inside.c, which takes fifteen seconds; it hands these out.
   Those that need more define TEST_INSIDE before test.h and have the implementation in themselves. */
#ifndef DIST_TEST_INSIDE_H
#define DIST_TEST_INSIDE_H

/* A camera in double, as dist_render takes it: its rotation orthonormal, center = -R^T t. */
typedef struct inside_view {
    double rotation[9], translation[3], center[3], fx, fy, cx, cy, skew, first;
} inside_view;

/* What a tape keeps of each pixel, and the order of its tiles; borrowed. */
typedef struct inside_tape {
    const float *s, *sample;
    const unsigned *cost;
    const int *order;
    int tiled; /* pixels of a tile's side */
} inside_tape;

/* Fills what the context's workers work in: no result may depend on what an earlier call has left there. */
void inside_soil(dist_context *ctx, int byte);

void inside_rotate(const double m[9], const double a[3], double b[3]);
void inside_rotate_back(const double m[9], const double a[3], double b[3]);
void inside_orthonormalize(double m[9]);
double inside_rotation_off(const double m[9], double *determinant);
inside_view inside_view_of(const dist_camera *camera);
/* Of unit length, in camera space; places between pixels are welcome. */
void inside_view_direction(const inside_view *view, double x, double y, double direction[3]);

inside_tape inside_tape_of(const dist_tape *tape);
int inside_tape_missed(const dist_tape *tape, size_t i); /* a miss whose sample of least |f| is kept */
int inside_tile_outward(int across, int down, int index);

float inside_cache_clear(const dist_cache *cache, const float p[3]);
const unsigned char *inside_cache_cells(const dist_cache *cache); /* (resolution)^3; borrowed */
/* Instance k's bounding sphere: center and radius, in the world. */
void inside_ball(const dist_scene *scene, int k, float ball[4]);
/* Where instance k is asked for a point of the world: q, in its own space. Returns how far p is outside its ball. */
float inside_local(const dist_scene *scene, int k, const float p[3], float q[3]);

/* Nets: the points of a block, the values a wide pass takes at most, layers at most. */
enum { INSIDE_BLOCK = 48, INSIDE_WIDE = 384, INSIDE_LAYERS = 32 };
/* Where layer l's units stand in memory: returns their number; unit[i] is the i-th, place its inverse. Borrowed. */
int inside_units(const dist_net *net, int l, const int **unit, const int **place);
void inside_units_in_order(dist_net *net); /* no longer moved */
double inside_done(dist_context *ctx);     /* multiply-adds of the first worker since this was last asked */
int inside_groups(dist_shape *shape, int groups); /* whether blocks come in groups, 2 or 0; returns what it was */
int inside_is_wide(const dist_shape *shape); /* its queries cost enough to look at a batch first */
double inside_encoding_base(const dist_net *net);

/* An activation and its slope by the scalar kernel; its second derivative from the two. */
float inside_activate(int activation, float parameter, float x, float *slope);
float inside_curvature(int activation, float parameter, float value, float slope);
/* Where a ray between two samples of f = 0 ends; its status. */
int inside_bracket_of_zeros(dist_context *ctx, const dist_field *field, float from, float to, float *best);

/* A float as PLY files hold it, with a 0 behind it; and what is read of it: the number, how many bytes it took. */
size_t inside_decimal(float x, unsigned char text[64]);
size_t inside_number(const unsigned char *text, size_t size, float *x);
/* The triangles of a cube of 8 corners, those of the bits of code inside: as triples of edges. Returns their number. */
int inside_cube(int code, unsigned char edges[18]);
int inside_edges_share_face(int e, int f);

#endif
