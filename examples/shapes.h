/* SPDX-License-Identifier: MIT-0
   shapes.h - four endless families of solids with known distances: sofas, aircraft, tables and cars.

   Each shape follows from its family and its index alone: about a dozen random numbers choose the proportions of
   rounded boxes, cones, cylinders and prisms, which are joined, blended and cut. y is up, +z is the front, x the width;
   the shape is centered and its corners reach a radius of SHAPE_RADIUS. Distances never exceed the true ones by more
   than a little (blends and cuts fall short of it), and the slope is 1 next to the surface. By convention indices from
   SHAPE_HELD_OUT on are never trained on. */
#ifndef DIST_EXAMPLES_SHAPES_H
#define DIST_EXAMPLES_SHAPES_H

#include <math.h>
#include <stdint.h>
#include <string.h>

enum { SHAPE_SOFA, SHAPE_PLANE, SHAPE_TABLE, SHAPE_CAR, SHAPE_FAMILIES };
enum { SHAPE_HELD_OUT = 1000 };

#define SHAPE_RADIUS 0.92f

enum { SHAPE_MAX_PARTS = 24, SHAPE_MAX_CORNERS = 8 };
enum { SHAPE_BOX, SHAPE_CONE, SHAPE_CYLINDER, SHAPE_PRISM, SHAPE_HALFSPACE };

/* size: box: half extents; cone: bottom radius, top radius, half length between the two spheres; cylinder: radius, half
   height; prism: half depth along z; half-space: none, it is the side y > 0.
   Boxes and cylinders include their rounding; a prism's polygon and depth grow by it. */
typedef struct shape_part {
    int kind;
    int mirror;  /* stands on both sides of x = 0 */
    int cut;     /* taken away instead of added */
    float blend; /* width of the smooth transition to what was there before; 0: a sharp edge */
    float center[3];
    float axes[9]; /* rows: the part's own x, y, z */
    float size[3];
    float round;
    float bound; /* radius around the center that holds the part */
    int corner_count;
    float corner[SHAPE_MAX_CORNERS][2];
} shape_part;

typedef struct shape {
    int family;
    unsigned index;
    int part_count;
    shape_part part[SHAPE_MAX_PARTS];
} shape;

static inline const char *shape_family_name(int family)
{
    static const char *const names[SHAPE_FAMILIES] = {"sofas", "planes", "tables", "cars"};
    return family >= 0 && family < SHAPE_FAMILIES ? names[family] : "none";
}

/* ---- distance
 * --------------------------------------------------------------------------------------------------------- */

static float shape_length(float x, float y)
{
    return sqrtf(x * x + y * y);
}

/* Distance to the profile {x <= 0, y <= 0}: what box, cylinder and prism have in common. */
static float shape_corner_distance(float x, float y)
{
    float inner = x > y ? x : y;
    if (inner <= 0.0f) return inner;
    return shape_length(x > 0.0f ? x : 0.0f, y > 0.0f ? y : 0.0f);
}

static float shape_box_distance(const shape_part *part, const float q[3])
{
    float x = fabsf(q[0]) - part->size[0] + part->round;
    float y = fabsf(q[1]) - part->size[1] + part->round;
    float z = fabsf(q[2]) - part->size[2] + part->round;
    float inner = x > y ? x : y;
    inner = inner > z ? inner : z;
    if (inner <= 0.0f) return inner - part->round;
    x = x > 0.0f ? x : 0.0f;
    y = y > 0.0f ? y : 0.0f;
    z = z > 0.0f ? z : 0.0f;
    return sqrtf(x * x + y * y + z * z) - part->round;
}

/* The hull of two spheres, exact. */
static float shape_cone_distance(const shape_part *part, const float q[3])
{
    float height = 2.0f * part->size[2];
    float slope = (part->size[0] - part->size[1]) / height;
    float side = sqrtf(1.0f - slope * slope);
    float x = shape_length(q[0], q[2]);
    float y = q[1] + part->size[2];
    float along = side * y - slope * x;
    if (along < 0.0f) return shape_length(x, y) - part->size[0];
    if (along > side * height) return shape_length(x, y - height) - part->size[1];
    return side * x + slope * y - part->size[0];
}

static float shape_polygon_distance(const shape_part *part, float x, float y)
{
    float nearest = 1e30f;
    int inside = 0;
    for (int i = 0, j = part->corner_count - 1; i < part->corner_count; j = i++) {
        float ax = part->corner[i][0], ay = part->corner[i][1];
        float ex = part->corner[j][0] - ax, ey = part->corner[j][1] - ay;
        float wx = x - ax, wy = y - ay;
        float t = (wx * ex + wy * ey) / (ex * ex + ey * ey);
        t = t < 0.0f ? 0.0f : t > 1.0f ? 1.0f : t;
        float dx = wx - t * ex, dy = wy - t * ey;
        float squared = dx * dx + dy * dy;
        nearest = squared < nearest ? squared : nearest;
        if ((ay > y) != (part->corner[j][1] > y) && x < ax + wy * ex / ey) inside = !inside;
    }
    return inside ? -sqrtf(nearest) : sqrtf(nearest);
}

static float shape_part_distance(const shape_part *part, const float q[3])
{
    float d = 0.0f;
    switch (part->kind) {
    case SHAPE_BOX: d = shape_box_distance(part, q); break;
    case SHAPE_CONE: d = shape_cone_distance(part, q); break;
    case SHAPE_CYLINDER:
        d = shape_corner_distance(shape_length(q[0], q[2]) - part->size[0] + part->round,
                                  fabsf(q[1]) - part->size[1] + part->round) -
            part->round;
        break;
    case SHAPE_PRISM:
        d = shape_corner_distance(shape_polygon_distance(part, q[0], q[1]), fabsf(q[2]) - part->size[0]) - part->round;
        break;
    case SHAPE_HALFSPACE: d = -q[1]; break;
    }
    return d;
}

static float shape_blend_min(float a, float b, float width)
{
    float nearer = a < b ? a : b;
    float overlap = width - fabsf(a - b);
    return overlap > 0.0f ? nearer - 0.25f * overlap * overlap / width : nearer;
}

/* Negative inside. A part that its bounding sphere shows to be out of reach is not looked at: same result, sooner. */
static inline float shape_distance(const shape *s, const float p[3])
{
    float d = 1e3f;
    for (int i = 0; i < s->part_count; i++) {
        const shape_part *part = &s->part[i];
        float x = (part->mirror ? fabsf(p[0]) : p[0]) - part->center[0];
        float y = p[1] - part->center[1];
        float z = p[2] - part->center[2];
        float reach = part->bound + part->blend + (part->cut ? -d : d);
        if (part->kind != SHAPE_HALFSPACE && (reach <= 0.0f || x * x + y * y + z * z > reach * reach)) continue;
        const float *a = part->axes;
        float q[3] = {a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z};
        float e = shape_part_distance(part, q);
        d = part->cut ? -shape_blend_min(-d, e, part->blend) : shape_blend_min(d, e, part->blend);
    }
    return d;
}

/* ---- making
 * ----------------------------------------------------------------------------------------------------------- */

/* splitmix64: the same numbers everywhere. */
static uint64_t shape_random(uint64_t *state)
{
    *state += 0x9e3779b97f4a7c15u;
    uint64_t x = *state;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

static float shape_pick(uint64_t *state, float low, float high)
{
    float unit = (float)(shape_random(state) >> 40) / 16777216.0f;
    return low + (high - low) * unit;
}

static shape_part *shape_add(shape *s, int kind, float x, float y, float z)
{
    shape_part *part = &s->part[s->part_count++];
    memset(part, 0, sizeof *part);
    part->kind = kind;
    part->center[0] = x;
    part->center[1] = y;
    part->center[2] = z;
    part->axes[0] = part->axes[4] = part->axes[8] = 1.0f;
    return part;
}

static shape_part *shape_add_box(shape *s, float x, float y, float z, float hx, float hy, float hz, float round)
{
    shape_part *part = shape_add(s, SHAPE_BOX, x, y, z);
    part->size[0] = hx;
    part->size[1] = hy;
    part->size[2] = hz;
    float least = hx < hy ? hx : hy;
    least = least < hz ? least : hz;
    part->round = round < 0.98f * least ? round : 0.98f * least;
    return part;
}

static shape_part *shape_add_cylinder(shape *s, float x, float y, float z, float radius, float half, float round)
{
    shape_part *part = shape_add(s, SHAPE_CYLINDER, x, y, z);
    part->size[0] = radius;
    part->size[1] = half;
    float least = radius < half ? radius : half;
    part->round = round < 0.98f * least ? round : 0.98f * least;
    return part;
}

/* From a with radius ra to b with radius rb. */
static shape_part *shape_add_cone(shape *s, float ax, float ay, float az, float ra, float bx, float by, float bz,
                                  float rb)
{
    shape_part *part = shape_add(s, SHAPE_CONE, 0.5f * (ax + bx), 0.5f * (ay + by), 0.5f * (az + bz));
    float d[3] = {bx - ax, by - ay, bz - az};
    float length = sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    part->size[0] = ra;
    part->size[1] = rb;
    part->size[2] = 0.5f * length;
    for (int i = 0; i < 3; i++) d[i] /= length;
    /* Any two directions across will do: the part is round. */
    float u[3] = {1.0f, 0.0f, 0.0f};
    if (fabsf(d[0]) > 0.8f) {
        u[0] = 0.0f;
        u[1] = 1.0f;
    }
    float dot = u[0] * d[0] + u[1] * d[1] + u[2] * d[2];
    for (int i = 0; i < 3; i++) u[i] -= dot * d[i];
    length = sqrtf(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
    for (int i = 0; i < 3; i++) {
        part->axes[i] = u[i] / length;
        part->axes[3 + i] = d[i];
    }
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        part->axes[6 + i] = part->axes[j] * part->axes[3 + k] - part->axes[k] * part->axes[3 + j];
    }
    return part;
}

/* Turns the part about its center by an angle around the world's x, y or z axis (0, 1, 2). */
static void shape_turn(shape_part *part, int around, float angle)
{
    float c = cosf(angle), s = sinf(angle);
    int j = (around + 1) % 3, k = (around + 2) % 3;
    for (int row = 0; row < 3; row++) {
        float *a = &part->axes[3 * row];
        float u = c * a[j] - s * a[k];
        a[k] = s * a[j] + c * a[k];
        a[j] = u;
    }
}

/* A prism of the polygon (z, y), extruded along x. */
static shape_part *shape_add_profile(shape *s, float x, const float (*corner)[2], int count, float half, float round)
{
    shape_part *part = shape_add(s, SHAPE_PRISM, x, 0.0f, 0.0f);
    memcpy(part->corner, corner, (size_t)count * sizeof part->corner[0]);
    part->corner_count = count;
    part->size[0] = half - round;
    part->round = round;
    static const float axes[9] = {0.0f, 0.0f, 1.0f, 0.0f, 1.0f, 0.0f, 1.0f, 0.0f, 0.0f};
    memcpy(part->axes, axes, sizeof axes);
    return part;
}

/* A surface that tapers from the root chord at (0, z) to the tip chord at the span, swept back and lifted by an angle.
   z is the middle of the root; upright: the span goes up instead of sideways. */
static shape_part *shape_add_wing(shape *s, float x, float y, float z, float root, float tip, float span, float sweep,
                                  float half, float lift, int upright)
{
    shape_part *part = shape_add(s, SHAPE_PRISM, x, y, z);
    float round = 0.8f * half;
    float corner[4][2] = {
        {0.0f, -0.5f * root}, {span, -sweep - 0.5f * tip}, {span, -sweep + 0.5f * tip}, {0.0f, 0.5f * root}};
    memcpy(part->corner, corner, sizeof corner);
    part->corner_count = 4;
    part->size[0] = half - round;
    part->round = round;
    static const float flat[9] = {1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, -1.0f, 0.0f};
    static const float up[9] = {0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 1.0f, 0.0f, 0.0f};
    memcpy(part->axes, upright ? up : flat, sizeof flat);
    if (!upright) {
        shape_turn(part, 2, lift);
        part->mirror = 1;
    }
    return part;
}

/* ---- families
 * --------------------------------------------------------------------------------------------------------- */

static void shape_make_sofa(shape *s, uint64_t *state)
{
    float half_width = shape_pick(state, 0.72f, 1.12f);
    float half_depth = shape_pick(state, 0.40f, 0.50f);
    float seat = shape_pick(state, 0.36f, 0.46f);
    float back = seat + shape_pick(state, 0.30f, 0.52f);
    float arm = seat + shape_pick(state, 0.08f, 0.28f);
    float arm_half = shape_pick(state, 0.07f, 0.13f);
    float back_half = shape_pick(state, 0.08f, 0.12f);
    float tilt = shape_pick(state, 0.0f, 0.22f);
    float round = shape_pick(state, 0.02f, 0.07f);
    float cushion = shape_pick(state, 0.06f, 0.085f);
    float leg = shape_pick(state, 0.04f, 0.15f);
    int rolled = shape_pick(state, 0.0f, 1.0f) < 0.4f;
    int seats = half_width + shape_pick(state, -0.15f, 0.15f) < 0.9f ? 2 : 3;
    int cushioned_back = shape_pick(state, 0.0f, 1.0f) < 0.5f;
    float chaise = shape_pick(state, -0.9f, 0.45f);
    float inner = half_width - 2.0f * arm_half;
    float base_half = 0.5f * (seat - 1.5f * cushion - leg);

    shape_add_box(s, 0.0f, leg + base_half, 0.0f, half_width - 0.02f, base_half, half_depth - 0.02f, 0.03f);
    float back_lift = 0.5f * (back - leg);
    shape_turn(shape_add_box(s, 0.0f, leg + back_lift, back_half - half_depth - 0.3f * tilt,
                             half_width - (rolled ? arm_half : 0.0f), back_lift, back_half, round),
               0, -tilt);
    float top = rolled ? arm - 1.1f * arm_half : arm;
    shape_add_box(s, half_width - arm_half, 0.5f * (leg + top), 0.0f, arm_half, 0.5f * (top - leg), half_depth, round)
        ->mirror = 1;
    if (rolled) {
        shape_part *roll =
            shape_add_cylinder(s, half_width - 0.9f * arm_half, top, 0.0f, 1.25f * arm_half, half_depth + 0.01f, 0.03f);
        shape_turn(roll, 0, 1.5707963f);
        roll->mirror = 1;
    }
    float front = half_depth + 0.01f, rear = -half_depth + 1.6f * back_half;
    for (int i = 0; i < seats; i++) {
        float half = inner / (float)seats;
        float x = -inner + half * (float)(2 * i + 1);
        float reach = i == seats - 1 && chaise > 0.1f ? chaise : 0.0f;
        float z = 0.5f * (front + rear + reach);
        shape_add_box(s, x, seat - cushion, z, half, cushion, 0.5f * (front - rear + reach), 0.8f * cushion);
        if (reach > 0.0f)
            shape_add_box(s, x + 0.5f * arm_half, leg + base_half, z, half + 0.5f * arm_half - 0.01f, base_half,
                          0.5f * (front - rear + reach) - 0.02f, 0.03f);
        if (!cushioned_back) continue;
        float lift = 0.42f * (back - seat);
        shape_turn(
            shape_add_box(s, x, seat + lift, rear + 0.5f * cushion - tilt * lift, half, lift, cushion, 0.8f * cushion),
            0, -tilt);
    }
    for (int i = 0; i < 2; i++) {
        float z = (half_depth - 0.08f) * (i == 0 ? 1.0f : -1.0f);
        shape_add_cylinder(s, half_width - 0.1f, 0.5f * leg + 0.02f, z, 0.045f, 0.5f * leg + 0.02f, 0.01f)->mirror = 1;
    }
}

static void shape_make_plane(shape *s, uint64_t *state)
{
    float radius = shape_pick(state, 0.09f, 0.135f);
    float nose = shape_pick(state, 0.85f, 1.0f);
    float tail = shape_pick(state, 0.85f, 1.05f);
    float span = shape_pick(state, 0.75f, 1.05f);
    float root = shape_pick(state, 0.30f, 0.44f);
    float tip = root * shape_pick(state, 0.35f, 0.7f);
    float sweep = shape_pick(state, 0.05f, 0.5f);
    float lift = shape_pick(state, 0.02f, 0.14f);
    float middle = shape_pick(state, 0.0f, 0.18f);
    int high = shape_pick(state, 0.0f, 1.0f) < 0.3f;
    float fin = shape_pick(state, 0.28f, 0.40f);
    float stabilizer = shape_pick(state, 0.30f, 0.42f);
    int tee = shape_pick(state, 0.0f, 1.0f) < 0.3f;
    int engines = (int)shape_pick(state, 0.0f, 3.99f); /* two or four under the wings, two at the tail, a propeller */
    float engine = shape_pick(state, 0.055f, 0.075f);
    float half = 0.038f;

    float slope = 0.6f * radius;
    shape_add_cone(s, 0.0f, 0.0f, -0.25f * tail, radius, 0.0f, 0.0f, nose - 2.2f * radius, radius);
    shape_add_cone(s, 0.0f, 0.0f, -0.25f * tail, radius, 0.0f, slope, 0.05f - tail, 0.045f);
    shape_add_cone(s, 0.0f, 0.0f, nose - 2.2f * radius, radius, 0.0f, -0.25f * radius, nose - 0.6f * radius,
                   0.6f * radius);
    float wing_y = high ? 0.7f * radius : -0.5f * radius;
    if (engines == 3) {
        sweep *= 0.15f;
        tip = 0.8f * root;
    }
    shape_add_wing(s, 0.0f, wing_y, middle, root, tip, span, sweep, half, high ? 0.3f * lift : lift, 0)->blend = 0.04f;
    float fin_y = 0.5f * slope;
    float fin_z = 0.16f - tail;
    shape_add_wing(s, 0.0f, fin_y, fin_z, 0.30f, 0.16f, fin, 0.1f + 0.35f * sweep, half, 0.0f, 1)->blend = 0.03f;
    float tail_y = tee ? fin_y + fin : slope;
    float tail_z = tee ? fin_z - 0.1f - 0.35f * sweep : fin_z - 0.02f;
    shape_add_wing(s, 0.0f, tail_y, tail_z, 0.19f, 0.12f, stabilizer, 0.05f + 0.3f * sweep, half, 0.0f, 0)->blend =
        0.03f;

    if (engines < 2) {
        for (int i = 0; i <= engines; i++) {
            float t = engines == 0 ? 0.36f : 0.30f + 0.30f * (float)i;
            float x = t * span;
            float y = wing_y + sinf(high ? 0.3f * lift : lift) * x - half - 0.9f * engine;
            float z = middle - t * sweep + 0.5f * (root + t * (tip - root)) + 0.02f;
            shape_part *pod = shape_add_cylinder(s, x, y, z, engine, 0.15f, 0.04f);
            shape_turn(pod, 0, 1.5707963f);
            pod->mirror = 1;
        }
    } else if (engines == 2) {
        shape_part *pod =
            shape_add_cylinder(s, radius + 0.85f * engine, 0.35f * radius, -0.45f * tail, engine, 0.16f, 0.04f);
        shape_turn(pod, 0, 1.5707963f);
        pod->mirror = 1;
    } else {
        float z = nose + 0.02f;
        shape_add_cone(s, 0.0f, -0.25f * radius, z - 0.1f, 0.06f, 0.0f, -0.25f * radius, z + 0.04f, 0.035f);
        shape_add_cone(s, 0.09f, -0.25f * radius - 0.2f, z, 0.038f, -0.09f, -0.25f * radius + 0.2f, z, 0.038f);
        float canopy = 0.55f * radius;
        shape_add_cone(s, 0.0f, canopy, middle - 0.1f, 0.8f * canopy, 0.0f, canopy, middle + 0.28f, canopy)->blend =
            0.04f;
    }
}

static void shape_make_table(shape *s, uint64_t *state)
{
    int round_top = shape_pick(state, 0.0f, 1.0f) < 0.4f;
    float half_width = shape_pick(state, 0.55f, 1.0f);
    float half_depth = round_top ? half_width : half_width * shape_pick(state, 0.5f, 0.95f);
    float height = shape_pick(state, 0.5f, 1.1f);
    float top = shape_pick(state, 0.045f, 0.07f);
    float leg = shape_pick(state, 0.05f, 0.075f);
    float splay = shape_pick(state, -0.1f, 0.16f);
    float inset = shape_pick(state, 0.03f, 0.16f);
    float style = shape_pick(state, 0.0f, 1.0f);
    float shelf = shape_pick(state, -0.4f, 0.5f);
    float apron = shape_pick(state, -0.08f, 0.12f);
    float foot = shape_pick(state, 0.45f, 0.7f);
    float round = shape_pick(state, 0.01f, 0.035f);

    if (round_top) shape_add_cylinder(s, 0.0f, height - top, 0.0f, half_width, top, round);
    else shape_add_box(s, 0.0f, height - top, 0.0f, half_width, top, half_depth, round);
    float under = height - 2.0f * top;
    if (round_top && style < 0.5f) {
        shape_add_cylinder(s, 0.0f, 0.5f * under, 0.0f, 1.5f * leg, 0.5f * under + 0.01f, 0.01f)->blend = 0.05f;
        shape_add_cylinder(s, 0.0f, 0.045f, 0.0f, foot * half_width, 0.045f, 0.035f)->blend = 0.12f;
        return;
    }
    float x = round_top ? 0.7071f * half_width - inset : half_width - leg - inset;
    float z = round_top ? x : half_depth - leg - inset;
    float out = splay > 0.0f ? splay : 0.0f;
    int square = !round_top && style < 0.6f;
    for (int i = 0; i < 2; i++) {
        float side = i == 0 ? 1.0f : -1.0f;
        if (square)
            shape_add_box(s, x, 0.5f * under + 0.01f, side * z, leg, 0.5f * under + 0.01f, leg, 0.012f)->mirror = 1;
        else
            shape_add_cone(s, x + out, 0.85f * leg, side * (z + out), 0.85f * leg, x, under, side * z, 1.15f * leg)
                ->mirror = 1;
    }
    if (apron > 0.0f) {
        float y = under - 0.5f * apron - 0.03f;
        shape_add_box(s, 0.0f, y, 0.0f, x, 0.5f * apron + 0.04f, z, 0.01f);
        shape_part *hollow = shape_add_box(s, 0.0f, y - 0.06f, 0.0f, x - 0.1f, 0.5f * apron + 0.06f, z - 0.1f, 0.01f);
        hollow->cut = 1;
    }
    if (shelf > 0.15f && square)
        shape_add_box(s, 0.0f, shelf * height, 0.0f, x + 0.5f * leg, 0.04f, z + 0.5f * leg, 0.015f);
}

static void shape_make_car(shape *s, uint64_t *state)
{
    float width = shape_pick(state, 0.36f, 0.44f);
    float wheel = shape_pick(state, 0.155f, 0.195f);
    float droop = shape_pick(state, 0.02f, 0.09f);
    float hood = 2.0f * wheel + shape_pick(state, 0.09f, 0.16f);
    float shield = shape_pick(state, 0.25f, 0.48f); /* z of the windshield's foot */
    float rake = shape_pick(state, 0.14f, 0.34f);   /* from there back to the roof */
    float roof = hood + shape_pick(state, 0.20f, 0.34f);
    float box = shape_pick(state, 0.0f, 1.0f); /* 0: a notchback, 1: the roof goes to the rear */
    float trunk = hood + shape_pick(state, -0.02f, 0.05f);
    float front_axle = shape_pick(state, 0.56f, 0.64f);
    float rear_axle = shape_pick(state, -0.66f, -0.56f);
    float lean = shape_pick(state, 0.08f, 0.30f); /* of the side windows */
    int pickup = shape_pick(state, 0.0f, 1.0f) < 0.15f;
    float round = 0.06f;

    float roof_end = -0.28f - 0.54f * box, glass_end = -0.64f - 0.28f * box;
    if (pickup) {
        roof_end = -0.10f;
        glass_end = -0.16f;
    }
    float belt = hood - 0.08f;
    const float cabin[5][2] = {{glass_end + round, belt},
                               {shield - round, belt},
                               {shield - rake, roof - round},
                               {0.5f * (shield - rake + roof_end), roof - round + 0.015f},
                               {roof_end, roof - round - 0.01f}};
    shape_add_profile(s, 0.0f, cabin, 5, width - 0.015f, round);
    for (int i = 0; i < 2; i++) {
        float side = i == 0 ? 1.0f : -1.0f;
        shape_part *window = shape_add(s, SHAPE_HALFSPACE, side * (width - 0.02f), hood - 0.02f, 0.0f);
        shape_turn(window, 2, side * (lean - 1.5707963f));
        window->cut = 1;
        window->blend = 0.05f;
    }
    float low = 0.6f * wheel + round;
    const float body[6][2] = {{-0.98f + round, low},  {0.98f - round, low},   {1.0f - round, hood - droop - round},
                              {shield, hood - round}, {-0.6f, trunk - round}, {-0.99f + round, trunk - 0.01f - round}};
    shape_add_profile(s, 0.0f, body, 6, width, round);
    if (pickup) {
        float mid = 0.5f * (glass_end - 0.05f - 0.93f);
        shape_add_box(s, 0.0f, trunk + 0.1f, mid, width - 0.075f, 0.27f, glass_end - 0.05f - mid, 0.03f)->cut = 1;
    }
    for (int i = 0; i < 2; i++) {
        float z = i == 0 ? front_axle : rear_axle;
        shape_part *arch = shape_add_cylinder(s, width, wheel, z, wheel + 0.045f, 0.13f, 0.01f);
        shape_turn(arch, 2, 1.5707963f);
        arch->mirror = 1;
        arch->cut = 1;
        arch->blend = 0.02f;
    }
    for (int i = 0; i < 2; i++) {
        shape_part *tire =
            shape_add_cylinder(s, width - 0.09f, wheel, i == 0 ? front_axle : rear_axle, wheel, 0.085f, 0.03f);
        shape_turn(tire, 2, 1.5707963f);
        tire->mirror = 1;
    }
}

/* ---- fitting into the sphere
 * ------------------------------------------------------------------------------------------ */

/* Calls back with points of a hull of spheres around them that holds the part, in world coordinates. */
static void shape_extend(const shape_part *part, float low[3], float high[3], const float center[3], float *radius)
{
    for (int i = 0; i < 16; i++) {
        float q[3] = {0.0f, 0.0f, 0.0f};
        float ball = part->round;
        float turn = 0.78539816f * (float)(i >> 1), side = i & 1 ? 1.0f : -1.0f;
        switch (part->kind) {
        case SHAPE_BOX:
            for (int k = 0; k < 3; k++) q[k] = (i >> k & 1 ? 1.0f : -1.0f) * (part->size[k] - ball);
            break;
        case SHAPE_CONE:
            q[1] = side * part->size[2];
            ball = part->size[i & 1];
            break;
        case SHAPE_CYLINDER:
            q[0] = cosf(turn) * (part->size[0] - ball);
            q[1] = side * (part->size[1] - ball);
            q[2] = sinf(turn) * (part->size[0] - ball);
            break;
        case SHAPE_PRISM:
            if (i >= 2 * part->corner_count) return;
            q[0] = part->corner[i >> 1][0];
            q[1] = part->corner[i >> 1][1];
            q[2] = side * part->size[0];
            break;
        case SHAPE_HALFSPACE: return;
        }
        float p[3], squared = 0.0f;
        for (int k = 0; k < 3; k++) {
            p[k] = part->center[k] + part->axes[k] * q[0] + part->axes[3 + k] * q[1] + part->axes[6 + k] * q[2];
            if (p[k] - ball < low[k]) low[k] = p[k] - ball;
            if (p[k] + ball > high[k]) high[k] = p[k] + ball;
            squared += (p[k] - center[k]) * (p[k] - center[k]);
        }
        if (part->mirror && -p[0] - ball < low[0]) low[0] = -p[0] - ball;
        float reach = sqrtf(squared) + ball;
        if (reach > *radius) *radius = reach;
    }
}

static void shape_fit(shape *s)
{
    float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f};
    float center[3] = {0.0f, 0.0f, 0.0f};
    float radius = 0.0f;
    for (int i = 0; i < s->part_count; i++)
        if (!s->part[i].cut) shape_extend(&s->part[i], low, high, center, &radius);
    for (int k = 0; k < 3; k++) center[k] = 0.5f * (low[k] + high[k]);
    radius = 0.0f;
    for (int i = 0; i < s->part_count; i++)
        if (!s->part[i].cut) shape_extend(&s->part[i], low, high, center, &radius);

    float scale = SHAPE_RADIUS / radius;
    for (int i = 0; i < s->part_count; i++) {
        shape_part *part = &s->part[i];
        for (int k = 0; k < 3; k++) {
            /* A mirrored part stays at its distance from x = 0, which is where the mirror stands. */
            part->center[k] = (part->center[k] - (k == 0 ? 0.0f : center[k])) * scale;
            part->size[k] *= scale;
        }
        part->blend *= scale;
        part->round *= scale;
        for (int k = 0; k < part->corner_count; k++) {
            part->corner[k][0] *= scale;
            part->corner[k][1] *= scale;
        }
        float none_low[3] = {0.0f, 0.0f, 0.0f}, none_high[3] = {0.0f, 0.0f, 0.0f};
        shape_extend(part, none_low, none_high, part->center, &part->bound);
    }
}

static inline void shape_make(shape *s, int family, unsigned index)
{
    memset(s, 0, sizeof *s);
    s->family = family;
    s->index = index;
    uint64_t state = (uint64_t)(unsigned)family * 1000003u + index;
    shape_random(&state);
    switch (family) {
    case SHAPE_SOFA: shape_make_sofa(s, &state); break;
    case SHAPE_PLANE: shape_make_plane(s, &state); break;
    case SHAPE_TABLE: shape_make_table(s, &state); break;
    case SHAPE_CAR: shape_make_car(s, &state); break;
    default: break;
    }
    shape_fit(s);
}

/* ---- color ------------------------------------------------------------------------------------------------------- */

enum { SHAPE_COLORINGS = 64 };

/* What a coloring is made of: two hues on the color circle, and waves along three directions. */
typedef struct shape_coloring {
    float hue, contrast;
    float wave[3][3], phase[3]; /* sin(wave . p + phase) */
} shape_coloring;

/* Coloring `index`, the same for every shape but for a turn of the hue by family. */
static inline shape_coloring shape_coloring_make(int family, unsigned index)
{
    static const float way[3][3] = {{0.15f, 1.0f, 0.1f}, {1.0f, -0.1f, 0.35f}, {-0.3f, 0.2f, 1.0f}};
    static const float period[3] = {0.45f, 0.7f, 1.1f};
    shape_coloring c;
    uint64_t state = 7777u + index;
    shape_random(&state);
    c.hue = shape_pick(&state, 0.0f, 6.2831853f) + 0.4f * (float)family;
    c.contrast = shape_pick(&state, 1.5f, 3.5f);
    for (int i = 0; i < 3; i++) {
        float frequency = 6.2831853f / (period[i] * shape_pick(&state, 0.85f, 1.15f));
        for (int k = 0; k < 3; k++) c.wave[i][k] = frequency * way[i][k];
        c.phase[i] = shape_pick(&state, 0.0f, 6.2831853f);
    }
    return c;
}

/* Smooth, within 0.03 and 0.97: the first wave goes from one hue to the other, the second and third are light and
   dark. */
static inline void shape_color(const shape_coloring *c, const float p[3], float rgb[3])
{
    float s[3];
    for (int i = 0; i < 3; i++)
        s[i] = sinf(c->wave[i][0] * p[0] + c->wave[i][1] * p[1] + c->wave[i][2] * p[2] + c->phase[i]);
    float mix = 0.5f + 0.5f * s[0], light = 0.5f + 0.13f * s[1] + 0.1f * s[2];
    for (int k = 0; k < 3; k++) {
        float third = 2.0943951f * (float)k;
        float tint = (1.0f - mix) * cosf(c->hue - third) + mix * cosf(c->hue + c->contrast - third);
        rgb[k] = light + 0.24f * tint;
    }
}

#ifdef DIST_H
/* The field of an analytic shape: all that a field of one's own needs is this function and a bounding sphere. */
static inline void shape_values(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const shape *s = (const shape *)user;
    const float h = 1e-3f;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        sdf[i] = shape_distance(s, p);
        for (int k = 0; gradient && k < 3; k++) {
            float low[3] = {p[0], p[1], p[2]};
            float high[3] = {p[0], p[1], p[2]};
            low[k] -= h;
            high[k] += h;
            gradient[3 * i + (size_t)k] = (shape_distance(s, high) - shape_distance(s, low)) / (2.0f * h);
        }
    }
}

static inline dist_field shape_field(shape *s)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = s;
    field.eval_fn = shape_values;
    field.radius = 1.0f;
    field.lipschitz = 1.0f;
    return field;
}
#endif

#endif
