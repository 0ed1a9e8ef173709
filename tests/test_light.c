/* SPDX-License-Identifier: MIT-0
   test_light.c - examples/light.h: Lambert, highlights, shadows and ambient occlusion against closed forms */
#include "test.h"

#define COMMON_NO_MODEL
#include "../examples/common.h"
#include "../examples/light.h"

enum { SIDE = 48, PIXELS = SIDE * SIDE };

typedef struct scene {
    dist_context *ctx;
    float ball[4], floor[6];
    dist_field fields[2];
    dist_scene *both;
    dist_field field;
    dist_camera camera;
    float distance[PIXELS], normal[3 * PIXELS], color[3 * PIXELS];
    unsigned char mask[PIXELS];
    dist_images out;
} scene;

/* A ball of radius 0.3 over a floor whose upper side is y = -0.5, `lift` between them; floor 0: the ball alone. */
static void scene_open(scene *s, int floor, float lift)
{
    static const float half[3] = {2.0f, 0.25f, 2.0f};
    dist_instance instances[2];
    float eye[3] = {0.3f, 1.6f, 2.2f}, at[3] = {0.0f, -0.2f, 0.0f}, up[3] = {0.0f, 1.0f, 0.0f};
    dist_context_desc desc = test_context_desc();
    memset(s, 0, sizeof *s);
    memset(instances, 0, sizeof instances);
    s->ctx = dist_context_create(&desc);
    s->ball[1] = -0.2f + lift;
    s->ball[3] = 0.3f;
    s->floor[1] = -0.75f;
    memcpy(s->floor + 3, half, sizeof half);
    s->fields[0] = dist_field_sphere(s->ball);
    s->fields[1] = dist_field_box(s->floor);
    instances[0].field = &s->fields[0];
    instances[1].field = &s->fields[1];
    s->both = dist_scene_create(s->ctx, floor ? 2 : 1, instances);
    s->field = dist_scene_field(s->both);
    s->camera = dist_camera_look_at(SIDE, SIDE, 0.8f, eye, at, up);
    for (int i = 0; i < 3 * PIXELS; i++) s->color[i] = 1.0f;
    s->out.distance = s->distance;
    s->out.normal = s->normal;
    s->out.mask = s->mask;
    CHECK_STATUS(DIST_OK, dist_render(s->ctx, &s->field, &s->camera, NULL, &s->out, NULL), s->ctx);
    s->out.color = s->color;
}

static void scene_close(scene *s)
{
    dist_scene_destroy(s->both);
    dist_context_destroy(s->ctx);
}

static lighting one_light(float x, float y, float z, float ambient)
{
    static const float white[3] = {0.5f, 0.5f, 0.5f};
    lighting how;
    memset(&how, 0, sizeof how);
    how.count = 1;
    how.ambient = ambient;
    how.lights[0].toward[0] = x;
    how.lights[0].toward[1] = y;
    how.lights[0].toward[2] = z;
    memcpy(how.lights[0].color, white, sizeof white);
    return how;
}

/* Place and normal of a pixel's hit, in the world. */
static void hit_of(const scene *s, int pixel, double p[3], double n[3])
{
    float o[3], v[3];
    dist_camera_ray(&s->camera, (float)(pixel % SIDE), (float)(pixel / SIDE), o, v);
    for (int i = 0; i < 3; i++) p[i] = (double)o[i] + (double)s->distance[pixel] * (double)v[i];
    int ball = p[1] > -0.499;
    for (int i = 0; i < 3; i++) n[i] = ball ? (p[i] - (double)s->ball[i]) / (double)s->ball[3] : i == 1;
}

/* Red of a pixel of a picture, 0 to 1. */
static double red(const canvas *c, int pixel) { return c->rgb[3 * pixel] / 255.0; }

/* A light's direction from the camera's axes (right, up, back) to the world. */
static void toward_of(const scene *s, const lighting *how, double toward[3])
{
    const float *t = how->lights[0].toward, *r = s->camera.rotation;
    double length = sqrt((double)t[0] * (double)t[0] + (double)t[1] * (double)t[1] + (double)t[2] * (double)t[2]);
    for (int i = 0; i < 3; i++)
        toward[i] = ((double)r[i] * (double)t[0] - (double)r[3 + i] * (double)t[1] - (double)r[6 + i] * (double)t[2]) /
                    length;
}

TEST(light_is_the_cosine_and_a_highlight_stands_where_the_half_vector_does)
{
    static scene s;
    scene_open(&s, 0, 0.1f);
    for (int shine = 0; shine < 2; shine++) {
        lighting how = one_light(-0.6f, 0.7f, 0.5f, 0.2f);
        double l[3];
        int bathed = 0, dark = 0, bright = 0;
        how.shine = shine ? 0.5f : 0.0f;
        toward_of(&s, &how, l);
        canvas c = picture_lit(s.ctx, &s.field, &s.camera, &s.out, &how);
        for (int i = 0; i < PIXELS; i++) {
            double p[3], n[3], v[3], h[3], cosine = 0.0, away = 0.0, along = 0.0, size = 0.0;
            float o[3], d[3];
            if (!s.mask[i]) continue;
            hit_of(&s, i, p, n);
            dist_camera_ray(&s.camera, (float)(i % SIDE), (float)(i / SIDE), o, d);
            for (int k = 0; k < 3; k++) {
                cosine += n[k] * l[k];
                v[k] = (double)o[k] - p[k];
                away += v[k] * v[k];
            }
            for (int k = 0; k < 3; k++) {
                h[k] = l[k] + v[k] / sqrt(away);
                size += h[k] * h[k];
                along += h[k] * n[k];
            }
            double spot = cosine > 0.0 && shine && along > 0.0 ? 0.25 * pow(along / sqrt(size), 40.0) : 0.0;
            CHECK_NEAR(0.2 + 0.5 * fmax(cosine, 0.0) + spot, red(&c, i), 4e-3);
            bathed += cosine > 0.0;
            dark += cosine <= 0.0;
            bright += spot > 0.1;
        }
        if (test_state.verbose) printf("    %d bathed, %d dark, %d bright\n", bathed, dark, bright);
        CHECK(bathed > 50 && dark > 10 && (bright > 2) == shine);
        canvas_destroy(&c);
    }
    scene_close(&s);
}

TEST(a_ball_casts_its_shadow_and_nothing_else_is_dark)
{
    static scene s;
    scene_open(&s, 1, 0.4f);
    lighting how = one_light(-0.5f, 0.9f, 0.3f, 0.0f);
    double l[3];
    int shadow = 0, open = 0;
    how.shadow = 1;
    toward_of(&s, &how, l);
    canvas c = picture_lit(s.ctx, &s.field, &s.camera, &s.out, &how);
    for (int i = 0; i < PIXELS; i++) {
        double p[3], n[3], cosine = 0.0, along = 0.0, square = 0.0;
        if (!s.mask[i]) continue;
        hit_of(&s, i, p, n);
        for (int k = 0; k < 3; k++) {
            double q = p[k] - (double)s.ball[k];
            cosine += n[k] * l[k];
            along += q * l[k];
            square += q * q;
        }
        double miss = sqrt(square - along * along) - (double)s.ball[3]; /* of the line to the light past the ball */
        if (p[1] < -0.51 || fabs(miss) < 0.02 || fabs(cosine) < 0.1) continue; /* sides of the floor; rims */
        int blocked = n[1] > 0.999 && p[1] < -0.49 && along < 0.0 && miss < 0.0;
        CHECK_NEAR(blocked ? 0.0 : 0.5 * fmax(cosine, 0.0), red(&c, i), 4e-3);
        shadow += blocked;
        open += !blocked && cosine > 0.0;
    }
    CHECK(shadow > 20 && open > 200);
    canvas_destroy(&c);
    scene_close(&s);
}

TEST(ambient_light_is_what_a_ball_over_the_floor_leaves_of_the_sky)
{
    static scene s;
    scene_open(&s, 1, 0.1f);
    lighting how = one_light(0.0f, 0.0f, -1.0f, 1.0f); /* from behind the picture: nothing faces it */
    int covered = 0, open = 0;
    how.occlusion = 256;
    memset(how.lights[0].color, 0, sizeof how.lights[0].color);
    canvas c = picture_lit(s.ctx, &s.field, &s.camera, &s.out, &how);
    for (int i = 0; i < PIXELS; i++) {
        double p[3], n[3], square = 0.0;
        if (!s.mask[i]) continue;
        hit_of(&s, i, p, n);
        if (p[1] > -0.49 || p[1] < -0.51) continue;
        for (int k = 0; k < 3; k++) square += (p[k] - (double)s.ball[k]) * (p[k] - (double)s.ball[k]);
        /* a sphere wholly over the horizon takes (r / d)^2 cos of the cosine-weighted sky (form factor) */
        double up = (double)s.ball[1] - p[1], taken = 0.09 / square * up / sqrt(square);
        if (up < 0.3) continue;
        CHECK_NEAR(1.0 - taken, red(&c, i), 0.05); /* 256 rays */
        covered += taken > 0.2;
        open += taken < 0.05;
    }
    CHECK(covered > 10 && open > 100);
    canvas_destroy(&c);
    scene_close(&s);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(light_is_the_cosine_and_a_highlight_stands_where_the_half_vector_does);
    RUN(a_ball_casts_its_shadow_and_nothing_else_is_dark);
    RUN(ambient_light_is_what_a_ball_over_the_floor_leaves_of_the_sky);
    return test_report();
}
