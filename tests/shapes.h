/* SPDX-License-Identifier: MIT-0
   shapes.h - fields for the tests of tracing and rendering: worked out in double, rounded to float only at the end,
   that count and note what they are asked, and the first crossing of a ray with them, in double, by plain small
   steps. */
#ifndef DIST_TEST_SHAPES_H
#define DIST_TEST_SHAPES_H

#include "test.h"

enum {
    SHAPE_SPHERE,   /* radius */
    SHAPE_TORUS,    /* ring radius, tube radius; around y */
    SHAPE_BOX,      /* half extents; turned out of the axes */
    SHAPE_PLANE,    /* normal (3), offset: f = normal . p - offset */
    SHAPE_RODS,     /* radius of each of twelve */
    SHAPE_SHELLS,   /* thickness of each of three spheres, 0.3, 0.5 and 0.7 */
    SHAPE_BUMPY,    /* radius, amplitude, frequency of the bumps */
    SHAPE_CONSTANT, /* value */
    SHAPE_PAIR      /* thickness of each, gap: two plates across z, the nearer one at 0 */
};

enum { SHAPE_NOTES = 4096 };

typedef struct test_shape {
    int kind;
    double n[4];
    double slope, clamp, squash; /* f -> slope f, then clamped, then tanh(squash f); 0: not */
    double power;                /* f -> f^3 where it is 3, sign(f) where it is -1; 0: not */
    double poison;               /* NaN within this distance of (0, 0, 0.5); 0: nowhere */
    long queries, gradients;     /* points asked for, and of them those with a gradient */
    long clamped;                /* of those, where f is clamped */
    float *notes;                /* (SHAPE_NOTES, 4): point and value of each query; NULL: none */
} test_shape;

TEST_UNUSED static test_shape shape_make(int kind, double a, double b, double c, double d)
{
    test_shape shape;
    memset(&shape, 0, sizeof shape);
    shape.kind = kind;
    shape.n[0] = a;
    shape.n[1] = b;
    shape.n[2] = c;
    shape.n[3] = d;
    return shape;
}

static double shape_length(double x, double y, double z)
{
    return sqrt(x * x + y * y + z * z);
}

static double shape_box(const double half[3], const double p[3])
{
    double a[3], most = -1e30, outside = 0;
    for (int i = 0; i < 3; i++) {
        a[i] = fabs(p[i]) - half[i];
        most = fmax(most, a[i]);
        outside += a[i] > 0 ? a[i] * a[i] : 0;
    }
    return sqrt(outside) + fmin(most, 0);
}

/* Capsules of different directions; every one within the unit sphere. */
static double shape_rods(double radius, const double p[3])
{
    double least = 1e30;
    for (int k = 0; k < 12; k++) {
        double z = (k + 0.5) / 6 - 1, angle = 2.4 * k, s = sqrt(1 - z * z);
        double d[3] = {s * cos(angle), s * sin(angle), z};
        double o[3] = {0.5 * d[1], 0.5 * d[2], -0.5 * d[0]};
        double q[3] = {p[0] - o[0], p[1] - o[1], p[2] - o[2]};
        double t = q[0] * d[0] + q[1] * d[1] + q[2] * d[2];
        t = fmax(-0.45, fmin(0.45, t));
        least = fmin(least, shape_length(q[0] - t * d[0], q[1] - t * d[1], q[2] - t * d[2]));
    }
    return least - radius;
}

/* The shape before slope, clamp and the like: 1-Lipschitz but for the bumps, whose bound is 1 + amplitude frequency. */
static double shape_exact(const test_shape *shape, const double p[3])
{
    const double *n = shape->n;
    double length = shape_length(p[0], p[1], p[2]);
    switch (shape->kind) {
    case SHAPE_SPHERE: return length - n[0];
    case SHAPE_TORUS: return shape_length(sqrt(p[0] * p[0] + p[2] * p[2]) - n[0], p[1], 0) - n[1];
    case SHAPE_BOX: {
        double q[3] = {0.8 * p[0] + 0.6 * p[1], 0.8 * p[1] - 0.6 * p[0], p[2]};
        double r[3] = {q[0], 0.96 * q[1] + 0.28 * q[2], 0.96 * q[2] - 0.28 * q[1]};
        return shape_box(n, r);
    }
    case SHAPE_PLANE: return n[0] * p[0] + n[1] * p[1] + n[2] * p[2] - n[3];
    case SHAPE_RODS: return shape_rods(n[0], p);
    case SHAPE_SHELLS: return fmin(fabs(length - 0.3), fmin(fabs(length - 0.5), fabs(length - 0.7))) - 0.5 * n[0];
    case SHAPE_BUMPY: return length - n[0] + n[1] * sin(n[2] * p[0]) * cos(n[2] * p[1]);
    case SHAPE_PAIR: return fmin(fabs(p[2] + 0.5 * n[0]), fabs(p[2] + 1.5 * n[0] + n[1])) - 0.5 * n[0];
    default: return n[0];
    }
}

TEST_UNUSED static double shape_value(const test_shape *shape, const double p[3])
{
    double f = shape_exact(shape, p);
    if (shape->slope > 0) f *= shape->slope;
    if (shape->power > 0) f = f * f * f;
    if (shape->power < 0) f = f > 0 ? 0.01 : -0.01;
    if (shape->clamp > 0) f = fmax(-shape->clamp, fmin(shape->clamp, f));
    if (shape->squash > 0) f = tanh(shape->squash * f);
    return f;
}

TEST_UNUSED static void shape_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    test_shape *shape = (test_shape *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
        sdf[i] = (float)shape_value(shape, p);
        if (shape->poison > 0 && shape_length(p[0], p[1], p[2] - 0.5) < shape->poison) {
            uint32_t bits = 0x7fc00000u;
            memcpy(sdf + i, &bits, sizeof bits);
        }
        if (shape->notes && shape->queries < SHAPE_NOTES) {
            memcpy(shape->notes + 4 * shape->queries, points + 3 * i, 3 * sizeof(float));
            shape->notes[4 * shape->queries + 3] = sdf[i];
        }
        if (shape->notes || worker == 0) shape->queries++;
        if (!gradient) continue;
        if (worker == 0) shape->gradients++;
        if (worker == 0) shape->clamped += shape->clamp > 0 && fabs(shape_value(shape, p)) >= shape->clamp;
        for (size_t k = 0; k < 3; k++) {
            double a[3] = {p[0], p[1], p[2]}, b[3] = {p[0], p[1], p[2]}, h = 1e-6 * (1 + fabs(p[k]));
            a[k] += h;
            b[k] -= h;
            gradient[3 * i + k] = (float)((shape_value(shape, a) - shape_value(shape, b)) / (2 * h));
        }
    }
}

TEST_UNUSED static dist_field shape_field(test_shape *shape, double radius, double lipschitz)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = shape;
    field.eval_fn = shape_eval;
    field.radius = (float)radius;
    field.lipschitz = (float)lipschitz;
    field.clamp = (float)shape->clamp;
    return field;
}

/* One of each kind that tools and games meet. */
enum { SHAPES = 5 };

TEST_UNUSED static void make_shapes(test_shape shapes[SHAPES])
{
    shapes[0] = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    shapes[1] = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    shapes[2] = shape_make(SHAPE_BOX, 0.4, 0.5, 0.3, 0);
    shapes[3] = shape_make(SHAPE_RODS, 0.05, 0, 0, 0);
    shapes[4] = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    shapes[4].clamp = 0.1;
}

/* n rays from around the shape through it, and some from near by in any direction. */
TEST_UNUSED static void make_rays(test_random *random, const test_shape *shape, int n, float *origins,
                                  float *directions)
{
    for (int i = 0; i < n;) {
        float from[3], to[3], length = test_random_float(random, 0.3f, 3.0f);
        double p[3];
        test_random_direction(random, from);
        test_random_direction(random, to);
        for (int k = 0; k < 3; k++) {
            from[k] *= i % 3 ? 2.5f : test_random_float(random, 0.3f, 1.2f);
            to[k] = i % 3 ? 0.7f * to[k] - from[k] : to[k];
            p[k] = (double)from[k];
        }
        if (shape_value(shape, p) < 0.02) continue; /* in the solid */
        double size = shape_length((double)to[0], (double)to[1], (double)to[2]);
        for (int k = 0; k < 3; k++) {
            origins[3 * i + k] = from[k];
            directions[3 * i + k] = length * to[k] / (float)size;
        }
        i++;
    }
}

/* One worker: the counts of a shape are not guarded. */
TEST_UNUSED static dist_context *shape_context(void)
{
    dist_context_desc desc = test_context_desc();
    desc.workers = 1;
    return dist_context_create(&desc);
}

/* What a ray meets between t0 and t1. */
typedef struct shape_crossing {
    int crosses;
    int touched;  /* it came within epsilon before and went away again */
    double t;     /* of the first crossing from outside to inside */
    double least; /* smallest f before it; of the whole ray where it does not cross */
    double below; /* how deep the ray goes before it comes out again */
    double slope; /* df/dt at the crossing */
} shape_crossing;

static double shape_along(const test_shape *shape, const double o[3], const double d[3], double t)
{
    double p[3] = {o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]};
    return shape_exact(shape, p);
}

TEST_UNUSED static shape_crossing shape_cross(const test_shape *shape, const double o[3], const double d[3], double t0,
                                              double t1, double lipschitz, double step, double epsilon)
{
    shape_crossing c;
    memset(&c, 0, sizeof c);
    c.least = 1e30;
    double before = t0, t = t0;
    int close = 0;
    while (t <= t1) {
        double f = shape_along(shape, o, d, t);
        if (f < 0) {
            double a = before, b = t;
            for (int i = 0; i < 60; i++) {
                double m = 0.5 * (a + b);
                if (shape_along(shape, o, d, m) < 0) b = m;
                else a = m;
            }
            c.crosses = 1;
            c.t = b;
            c.slope = (shape_along(shape, o, d, b + 1e-7) - shape_along(shape, o, d, b - 1e-7)) / 2e-7;
            while (t <= t1 && f < 0) {
                c.below = fmax(c.below, -f);
                t += fmax(-f / lipschitz, step);
                f = shape_along(shape, o, d, t);
            }
            return c;
        }
        c.least = fmin(c.least, f);
        if (f < epsilon) close = 1;
        else if (close && f > 1.5 * epsilon) c.touched = 1;
        before = t;
        t += fmax(f / lipschitz, step);
    }
    return c;
}

/* Where a ray meets the bounding sphere around 0, not before its start; 0: nowhere. */
TEST_UNUSED static int shape_enter(const double o[3], const double d[3], double radius, double *t0, double *t1)
{
    double along = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]);
    double q = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]);
    if (q >= radius) return 0;
    double half = sqrt(radius * radius - q * q);
    *t0 = fmax(along - half, 0);
    *t1 = along + half;
    return *t1 > *t0;
}

/* Ray of pixel (x, y) in double, and its direction's z in the camera. The rotation is taken orthonormal, as the
   library does: the first row, the second without its part along that, and their cross product. */
TEST_UNUSED static double shape_pixel(const dist_camera *camera, int x, int y, double o[3], double d[3])
{
    double r[9], v[3];
    for (int i = 0; i < 6; i++) r[i] = (double)camera->rotation[i];
    double size = shape_length(r[0], r[1], r[2]);
    for (int i = 0; i < 3; i++) r[i] /= size;
    double along = r[0] * r[3] + r[1] * r[4] + r[2] * r[5];
    for (int i = 0; i < 3; i++) r[3 + i] -= along * r[i];
    size = shape_length(r[3], r[4], r[5]);
    for (int i = 0; i < 3; i++) r[3 + i] /= size;
    for (int i = 0; i < 3; i++) r[6 + i] = r[(i + 1) % 3] * r[3 + (i + 2) % 3] - r[(i + 2) % 3] * r[3 + (i + 1) % 3];
    v[1] = (y + (double)camera->pixel_center - (double)camera->cy) / (double)camera->fy;
    v[0] = (x + (double)camera->pixel_center - (double)camera->cx - (double)camera->skew * v[1]) / (double)camera->fx;
    v[2] = 1;
    double length = shape_length(v[0], v[1], v[2]);
    for (int i = 0; i < 3; i++) {
        d[i] = (r[i] * v[0] + r[3 + i] * v[1] + r[6 + i] * v[2]) / length;
        o[i] = 0;
        for (int k = 0; k < 3; k++) o[i] -= r[3 * k + i] * (double)camera->translation[k];
    }
    return 1 / length;
}

/* The camera of the reference pictures: 50 degrees, 2.4 away. */
TEST_UNUSED static dist_camera shape_camera(int width, int height)
{
    double length = shape_length(1.4, 1.0, 2.0);
    float eye[3] = {(float)(2.4 * 1.4 / length), (float)(2.4 / length), (float)(4.8 / length)};
    float at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    return dist_camera_look_at(width, height, (float)(50.0 * 3.14159265358979323846 / 180), eye, at, up);
}

/* One pixel that looks along +z from 0. */
TEST_UNUSED static dist_camera shape_pinhole(void)
{
    dist_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.fx = camera.fy = 1;
    camera.rotation[0] = camera.rotation[4] = camera.rotation[8] = 1;
    camera.width = camera.height = 1;
    return camera;
}

/* A picture of at most SHAPE_PIXELS pixels, and what asks for all its planes but the color. */
enum { SHAPE_PIXELS = 128 * 128 };
typedef struct shape_picture {
    float depth[SHAPE_PIXELS], distance[SHAPE_PIXELS], error[SHAPE_PIXELS], silhouette[SHAPE_PIXELS];
    float normal[3 * SHAPE_PIXELS], color[3 * SHAPE_PIXELS];
    unsigned char mask[SHAPE_PIXELS], status[SHAPE_PIXELS];
    dist_stats stats;
} shape_picture;

TEST_UNUSED static dist_images shape_planes(shape_picture *p)
{
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = p->depth;
    out.distance = p->distance;
    out.error = p->error;
    out.silhouette = p->silhouette;
    out.normal = p->normal;
    out.mask = p->mask;
    out.status = p->status;
    out.stats = &p->stats;
    return out;
}

#endif
