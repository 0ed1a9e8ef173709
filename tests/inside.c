/* SPDX-License-Identifier: MIT-0
   inside.c - the library that tests are linked with, and what inside.h shows of it */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "inside.h"

void inside_soil(dist_context *ctx, int byte)
{
    memset(ctx->scratch, byte, (size_t)ctx->workers * DISTI_SCRATCH_BYTES);
    if (ctx->lanes) memset(ctx->lanes, byte, (size_t)ctx->workers * ctx->lane_bytes);
    if (ctx->partial) memset(ctx->partial, byte, DISTI_SLOTS * ctx->partial_size * sizeof(double));
}

/* ---- cameras ----------------------------------------------------------------------------------------------------- */

void inside_rotate(const double m[9], const double a[3], double b[3]) { disti_rotate(m, a, b); }
void inside_rotate_back(const double m[9], const double a[3], double b[3]) { disti_rotate_back(m, a, b); }
void inside_orthonormalize(double m[9]) { disti_orthonormalize(m); }
double inside_rotation_off(const double m[9], double *determinant) { return disti_rotation_off(m, determinant); }

inside_view inside_view_of(const dist_camera *camera)
{
    disti_view from;
    inside_view view;
    disti_view_of(camera, &from);
    memcpy(view.rotation, from.rotation, sizeof view.rotation);
    memcpy(view.translation, from.translation, sizeof view.translation);
    memcpy(view.center, from.center, sizeof view.center);
    view.fx = from.fx;
    view.fy = from.fy;
    view.cx = from.cx;
    view.cy = from.cy;
    view.skew = from.skew;
    view.first = from.first;
    return view;
}

void inside_view_direction(const inside_view *view, double x, double y, double direction[3])
{
    disti_view to;
    memset(&to, 0, sizeof to);
    to.fx = view->fx;
    to.fy = view->fy;
    to.cx = view->cx;
    to.cy = view->cy;
    to.skew = view->skew;
    to.first = view->first;
    disti_view_direction(&to, x, y, direction);
}

/* ---- pictures ---------------------------------------------------------------------------------------------------- */

inside_tape inside_tape_of(const dist_tape *tape)
{
    inside_tape t;
    t.s = tape->s;
    t.sample = tape->sample;
    t.cost = tape->cost;
    t.order = tape->order;
    t.tiled = tape->tiled;
    return t;
}

int inside_tape_missed(const dist_tape *tape, size_t i)
{
    return (tape->status[i] & 15) == DIST_RAY_MISS && (tape->status[i] & DISTI_TAPE_SAMPLE) != 0;
}

int inside_tile_outward(int across, int down, int index) { return disti_tile_outward(across, down, index); }

/* ---- caches and scenes ------------------------------------------------------------------------------------------- */

float inside_cache_clear(const dist_cache *cache, const float p[3]) { return disti_cache_clear(cache, p); }

const unsigned char *inside_cache_cells(const dist_cache *cache) { return cache->at; }

void inside_ball(const dist_scene *scene, int k, float ball[4])
{
    memcpy(ball, scene->ball[k].center, 3 * sizeof *ball);
    ball[3] = scene->ball[k].radius;
}

float inside_local(const dist_scene *scene, int k, const float p[3], float q[3])
{
    float d = disti_ball_distance(&scene->ball[k], p);
    disti_placed_local(&scene->placed[k], p, d > 0.0f, q);
    return d;
}

/* ---- nets -------------------------------------------------------------------------------------------------------- */

typedef char inside_limits[(int)INSIDE_BLOCK == (int)DISTI_BLOCK && (int)INSIDE_WIDE == (int)DISTI_WIDE_COLUMNS &&
                           (int)INSIDE_LAYERS == (int)DISTI_MAX_LAYERS ? 1 : -1];

int inside_units(const dist_net *net, int l, const int **unit, const int **place)
{
    *unit = net->unit_order ? net->unit_order + l * net->max_rows : NULL;
    *place = net->unit_order ? net->unit_order + (net->layers + l) * net->max_rows : NULL;
    return net->layer[l].out;
}

void inside_units_in_order(dist_net *net)
{
    for (int l = 0; l + 1 < net->layers; l++)
        for (int i = 0; i < net->layer[l].out; i++) {
            net->unit_order[l * net->max_rows + i] = i;
            net->unit_order[(net->layers + l) * net->max_rows + i] = i;
        }
    disti_net_pack(net);
}

double inside_done(dist_context *ctx)
{
    disti_counter *counter = disti_counter_of(ctx, 0);
    double done = (double)counter->done;
    counter->done = 0;
    return done;
}

int inside_groups(dist_shape *shape, int groups)
{
    int before = shape->groups;
    shape->groups = groups;
    return before;
}

int inside_is_wide(const dist_shape *shape) { return shape->wide; }

double inside_encoding_base(const dist_net *net) { return net->base; }

/* ---- numbers ----------------------------------------------------------------------------------------------------- */

float inside_activate(int activation, float parameter, float x, float *slope)
{
    return disti_activate_one(activation, parameter, x, slope);
}

float inside_curvature(int activation, float parameter, float value, float slope)
{
    return disti_curvature(activation, parameter, value, slope);
}

int inside_bracket_of_zeros(dist_context *ctx, const dist_field *field, float from, float to, float *best)
{
    disti_tracer tracer;
    disti_ray ray;
    disti_sample a, b;
    if (disti_tracer_init(&tracer, ctx, field, NULL, "inside_bracket_of_zeros") != DIST_OK) return -1;
    memset(&ray, 0, sizeof ray);
    a.s = from;
    b.s = to;
    a.f = b.f = 0.0f;
    for (int i = disti_ray_open_bracket(&tracer, &ray, a, b); i; i = disti_ray_advance(&tracer, &ray, 0.0f)) {}
    *best = ray.best;
    return ray.status;
}

size_t inside_decimal(float x, unsigned char text[64])
{
    disti_writer sink;
    sink.out = text;
    sink.size = 0;
    disti_sink_decimal(&sink, x);
    text[sink.size] = 0;
    return sink.size;
}

size_t inside_number(const unsigned char *text, size_t size, float *x)
{
    disti_text t;
    double wide = 0;
    t.at = (const char *)text;
    t.end = t.at + size;
    *x = disti_text_number(&t, &wide) ? disti_narrow(wide) : 0.0f;
    return (size_t)(t.at - (const char *)text);
}

/* ---- meshes ------------------------------------------------------------------------------------------------------ */

int inside_cube(int code, unsigned char edges[18])
{
    disti_case cases[256];
    disti_cases(cases);
    memcpy(edges, cases[code].edges, sizeof cases[code].edges);
    return cases[code].triangles;
}

int inside_edges_share_face(int e, int f) { return disti_edges_share_face(e, f); }
