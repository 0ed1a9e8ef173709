/* SPDX-License-Identifier: MIT-0
   collide.c - balls fall onto shapes that live in a neural network: a scene of instances, sphere contacts, shadow rays.
   cc -O2 examples/collide.c -lm -o collide && ./collide --out collide */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"

static const char usage[] =
    "collide [options]\n"
    "  --balls N      how many (default 60)\n"
    "  --seconds S    of falling (default 2.5)\n"
    "  --size WxH     of each of the six pictures (default 320x240)\n"
    "  --threads N    threads to use at most (default all)\n"
    "  --out STEM     STEM.png (default collide)\n";

enum { FIXED = 4, BALLS = 200, PICTURES = 6, STEPS_A_SECOND = 240 };

typedef struct balls {
    int count;
    float sphere[BALLS][4]; /* center and radius, as dist_field_collide takes them */
    float speed[BALLS][3];
    dist_contact contact[BALLS];
    size_t contacts;
} balls;

static float dot(const float *a, const float *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Out of what it is in, and back with 0.4 of the speed; along the surface a little is lost. */
static void bounce(float *x, float *v, const float *n, float depth)
{
    float into = dot(v, n);
    for (int k = 0; k < 3; k++) {
        x[k] += depth * n[k];
        if (into < 0) { v[k] = 0.99f * (v[k] - into * n[k]) - 0.4f * into * n[k]; }
    }
}

static void step(dist_context *ctx, const dist_field *fixed, balls *b)
{
    const float dt = 1.0f / STEPS_A_SECOND;
    for (int i = 0; i < b->count; i++) {
        b->speed[i][1] -= 9.81f * dt;
        for (int k = 0; k < 3; k++) { b->sphere[i][k] += dt * b->speed[i][k]; }
    }
    for (int i = 0; i < b->count; i++) { /* with each other: equal masses share */
        for (int j = 0; j < i; j++) {
            float n[3], minus[3];
            for (int k = 0; k < 3; k++) { n[k] = b->sphere[i][k] - b->sphere[j][k]; }
            float length = sqrtf(dot(n, n));
            float depth = b->sphere[i][3] + b->sphere[j][3] - length;
            if (depth <= 0 || length <= 0) { continue; }
            for (int k = 0; k < 3; k++) {
                n[k] /= length;
                minus[k] = -n[k];
            }
            float mean[3];
            for (int k = 0; k < 3; k++) { /* in the frame of both, each hits a wall */
                mean[k] = 0.5f * (b->speed[i][k] + b->speed[j][k]);
                b->speed[i][k] -= mean[k];
                b->speed[j][k] -= mean[k];
            }
            bounce(b->sphere[i], b->speed[i], n, 0.5f * depth);
            bounce(b->sphere[j], b->speed[j], minus, 0.5f * depth);
            for (int k = 0; k < 3; k++) {
                b->speed[i][k] += mean[k];
                b->speed[j][k] += mean[k];
            }
        }
    }
    dist_field_collide(ctx, fixed, (size_t)b->count, b->sphere[0], b->contact);
    for (int i = 0; i < b->count; i++) {
        if (b->contact[i].status != DIST_RAY_HIT) { continue; }
        b->contacts++;
        bounce(b->sphere[i], b->speed[i], b->contact[i].normal, b->contact[i].depth);
    }
}

/* The scene as it is, lit by one lamp. */
static canvas picture(dist_context *ctx, dist_scene *scene, const dist_camera *camera, unsigned long long *queries)
{
    static const float lamp[3] = {2.5f, 5.0f, 2.0f};
    size_t n = (size_t)camera->width * (size_t)camera->height;
    float *distance = take_floats(n), *normal = take_floats(3 * n), *points = take_floats(3 * n),
          *to_lamp = take_floats(3 * n);
    unsigned char *mask = (unsigned char *)take(n, 1);
    dist_hit *hits = (dist_hit *)take(n, sizeof *hits);
    int *instance = (int *)take(n, sizeof *instance);
    dist_field field = dist_scene_field(scene);
    dist_images out = {.distance = distance, .normal = normal, .mask = mask};
    dist_render_desc how = {.normal_space = DIST_SPACE_WORLD}, shadow = {.any_hit = 1, .max_distance = 1};
    dist_stats stats = {0};
    dist_render(ctx, &field, camera, &how, &out, NULL);
    for (size_t i = 0; i < n; i++) {
        float origin[3], direction[3];
        size_t x = i % (size_t)camera->width, y = i / (size_t)camera->width;
        dist_camera_ray(camera, (float)x, (float)y, origin, direction);
        for (size_t k = 0; k < 3; k++) { /* a little off the surface, so that it does not shade itself */
            points[3 * i + k] = mask[i] ? origin[k] + distance[i] * direction[k] + 4e-3f * normal[3 * i + k] : lamp[k];
            to_lamp[3 * i + k] = mask[i] ? lamp[k] - points[3 * i + k] : 1;
        }
    }
    dist_trace(ctx, &field, n, points, to_lamp, &shadow, hits, &stats);
    dist_scene_find(scene, n, points, instance);
    check(ctx);
    *queries += stats.queries;
    canvas c = canvas_create(camera->width, camera->height, 0.0f);
    paint_background(&c);
    for (size_t i = 0; i < n; i++) {
        static const float gold[3] = {0.86f, 0.74f, 0.52f}, gray[3] = {0.72f, 0.73f, 0.75f};
        float ball[3], light = 0.30f + 0.12f * normal[3 * i + 1];
        if (!mask[i]) { continue; }
        if (hits[i].status == DIST_RAY_MISS) {
            float cosine = dot(normal + 3 * i, to_lamp + 3 * i) / sqrtf(dot(to_lamp + 3 * i, to_lamp + 3 * i));
            light += cosine > 0 ? 0.65f * cosine : 0;
        }
        color_viridis(0.15f + 0.8f * (float)(instance[i] * 7 % 16) / 16.0f, ball);
        const float *color = instance[i] == 0 ? gray : instance[i] < FIXED ? gold : ball;
        int x = (int)i % camera->width, y = (int)i / camera->width;
        canvas_set(&c, x, y, light * color[0], light * color[1], light * color[2]);
    }
    free(distance);
    free(normal);
    free(points);
    free(to_lamp);
    free(mask);
    free(hits);
    free(instance);
    return c;
}

int main(int argc, char **argv)
{
    static balls b = {.count = 60};
    const char *stem = "collide";
    double seconds = 2.5;
    int width = 320, height = 240;
    dist_context_desc settings = {0};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--balls")) {
            b.count = option_int(&o, 1, BALLS);
        } else if (option_is(&o, "--seconds")) {
            seconds = option_number(&o, 0.01, 60);
        } else if (option_is(&o, "--size")) {
            option_size(&o, &width, &height);
        } else if (option_is(&o, "--threads")) {
            settings.workers = option_int(&o, 1, 1024);
        } else if (option_is(&o, "--out")) {
            stem = option_text(&o);
        } else {
            option_unknown(&o);
        }
    }
    check_stem(stem);

    /* a floor, three shapes of the embedded model, and the balls: one sphere, placed many times */
    dist_context *ctx = dist_context_create(&settings);
    dist_net *net = load_embedded(ctx);
    dist_shape *shapes[FIXED - 1];
    dist_field fields[FIXED];
    dist_instance all[FIXED + BALLS] = {{0}};
    const float floor_box[6] = {0, -0.1f, 0, 2.2f, 0.1f, 2.2f}, unit[4] = {0, 0, 0, 1};
    dist_field ball = dist_field_sphere(unit);
    fields[0] = dist_field_box(floor_box);
    for (int i = 1; i < FIXED; i++) {
        shapes[i - 1] = dist_shape_create(ctx, net, dist_net_code(net, 3 * i % dist_net_code_count(net)));
        fields[i] = dist_shape_field(shapes[i - 1]);
        const float side = (float)(i - 2);
        const float move[7] = {-0.15f, 0, -0.5f * side, 0, 1.35f * side, 0.37f, i == 2 ? -0.4f : 0.1f};
        dist_similarity_move(&all[i].placement, move);
    }
    for (int i = 0; i < FIXED; i++) { all[i].field = &fields[i]; }
    rng random = rng_begin(1);
    for (int i = 0; i < b.count; i++) {
        b.sphere[i][0] = 3.6f * (rng_uniform(&random) - 0.5f);
        b.sphere[i][1] = 1.2f + 1.6f * rng_uniform(&random);
        b.sphere[i][2] = 0.9f * (rng_uniform(&random) - 0.5f);
        b.sphere[i][3] = all[FIXED + i].placement.scale = 0.06f + 0.07f * rng_uniform(&random);
        all[FIXED + i].field = &ball;
    }
    dist_scene *fixed = dist_scene_create(ctx, FIXED, all);
    dist_scene *scene = dist_scene_create(ctx, FIXED + b.count, all);
    dist_field fixed_field = dist_scene_field(fixed);
    check(ctx);

    const float eye[3] = {0, 2.3f, 4.2f}, at[3] = {0, 0.55f, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(width, height, 0.75f, eye, at, up);
    canvas pictures[PICTURES];
    int steps = (int)(seconds * STEPS_A_SECOND), taken = 0;
    unsigned long long shadow_queries = 0;
    double falling = 0;
    progress p = progress_begin("falling");
    for (int i = 0; i < PICTURES; i++) {
        double start = seconds_now();
        for (; taken < steps * i / (PICTURES - 1); taken++) { step(ctx, &fixed_field, &b); }
        falling += seconds_now() - start;
        for (int k = 0; k < b.count; k++) {
            memcpy(all[FIXED + k].placement.translation, b.sphere[k], 3 * sizeof(float));
            dist_scene_set(scene, FIXED + k, &all[FIXED + k]);
        }
        pictures[i] = picture(ctx, scene, &camera, &shadow_queries);
        progress_show(&p, i + 1, PICTURES, "contacts", (double)b.contacts);
    }
    progress_end(&p);

    float deepest = 0;
    dist_field_collide(ctx, &fixed_field, (size_t)b.count, b.sphere[0], b.contact);
    check(ctx);
    for (int i = 0; i < b.count; i++) { deepest = b.contact[i].depth > deepest ? b.contact[i].depth : deepest; }
    canvas sheet = picture_sheet(PICTURES, pictures, NULL, 3);
    printf("%d balls, %d steps of %d in %.2f s, %lu contacts, at the end none deeper than %.4f\n"
           "%.2f queries a shadow ray\n%s written\n",
           b.count, taken, STEPS_A_SECOND, falling, (unsigned long)b.contacts, (double)deepest,
           (double)shadow_queries / ((double)width * height * PICTURES), write_canvas(stem, &sheet));
    for (int i = 0; i < PICTURES; i++) { canvas_destroy(&pictures[i]); }
    dist_scene_destroy(scene);
    dist_scene_destroy(fixed);
    for (int i = 0; i + 1 < FIXED; i++) { dist_shape_destroy(shapes[i]); }
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
