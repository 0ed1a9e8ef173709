/* SPDX-License-Identifier: MIT-0
   Real threads: whatever they do at the same time, all results are the same bits as those of one. make matrix builds
   this with a sanitizer that tells of memory which two of them touch at once. */
#include "test.h"

#ifdef __GLIBC__
#if __GLIBC_PREREQ(2, 34) /* threads without an option */
#include <pthread.h>
#define THREADS
#endif
#endif

#ifdef THREADS
/* Rays go in tasks of 1024, points of which the nearest is asked in tasks of 512. */
enum { W = 96, H = 72, POINTS = 2100, FEW = 700, RESULTS = 200, WORKERS = 7 };

/* A scheduler that starts threads for every job; they take its indices one by one. */
typedef struct crew {
    int workers;
    dist_task_fn task_fn;
    void *arg;
    int count, next;
    pthread_mutex_t lock;
} crew;

typedef struct hand {
    crew *of;
    int worker;
    pthread_t thread;
} hand;

static void *hand_main(void *user)
{
    const hand *h = (const hand *)user;
    crew *c = h->of;
    for (;;) {
        pthread_mutex_lock(&c->lock);
        int index = c->next++;
        pthread_mutex_unlock(&c->lock);
        if (index >= c->count) return NULL;
        c->task_fn(c->arg, index, h->worker);
    }
}

static void crew_run(void *user, int count, dist_task_fn task_fn, void *arg)
{
    crew *c = (crew *)user;
    hand hands[WORKERS];
    c->task_fn = task_fn;
    c->arg = arg;
    c->count = count;
    c->next = 0;
    for (int i = c->workers; i-- > 0;) {
        hands[i].of = c;
        hands[i].worker = i;
        if (i > 0 && pthread_create(&hands[i].thread, NULL, hand_main, &hands[i]) != 0) exit(1);
    }
    hand_main(&hands[0]);
    for (int i = 1; i < c->workers; i++) pthread_join(hands[i].thread, NULL);
}

/* What one life of a context resulted in: a hash of each array, by its name. */
typedef struct results {
    const char *names[RESULTS];
    uint64_t hashes[RESULTS];
    int count;
} results;

static void note(results *r, const char *name, const void *data, size_t bytes)
{
    const unsigned char *at = (const unsigned char *)data;
    uint64_t hash = 1469598103934665603u;
    for (size_t i = 0; i < bytes; i++) hash = (hash ^ at[i]) * 1099511628211u;
    if (r->count == RESULTS) exit(1);
    r->names[r->count] = name;
    r->hashes[r->count++] = hash;
}

static float depth[W * H], along[W * H], normal[3 * W * H], silhouette[W * H], color[3 * W * H], error[W * H];
static float d_plane[W * H], d_planes[3 * W * H];
static unsigned char status[W * H];
static float points[4 * POINTS], to[3 * POINTS], found[3 * POINTS], numbers[POINTS];
static dist_hit hits[POINTS];
static dist_contact contacts[POINTS];

typedef struct sums {
    float *numbers;
    size_t count;
    dist_gradients to;
} sums;

static sums sums_make(const dist_field *field)
{
    size_t code = (size_t)field->code_size, own = (size_t)field->color_code_size;
    sums s;
    memset(&s, 0, sizeof s);
    s.count = 10 + code + own + field->weight_count + field->color_weight_count;
    s.numbers = (float *)calloc(s.count, sizeof(float));
    if (!s.numbers) exit(1);
    s.to.code = s.numbers + 10;
    s.to.weights = s.to.code + code;
    return s;
}

/* A picture and its gradients: plain, certified, warm, by the paper's tracer, of few queries. */
static void life_of_pictures(dist_context *ctx, const dist_field *field, results *r)
{
    const float eye[3] = {1.4f, 1, 2.2f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    for (int mode = 0; mode < 5; mode++) {
        dist_camera camera = dist_camera_look_at(W, H, 0.7f, eye, at, up);
        dist_render_desc how;
        dist_images out, d_out;
        memset(&how, 0, sizeof how);
        memset(&out, 0, sizeof out);
        memset(&d_out, 0, sizeof d_out);
        how.certified = mode == 1;
        how.warm_start = mode == 2;
        how.trace = mode == 3 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        how.samples = mode == 3 ? 3 : 0;
        how.max_queries = mode == 4 ? 12000 : 0;
        out.depth = depth;
        out.distance = along;
        out.normal = normal;
        out.silhouette = silhouette;
        out.color = field->color_fn ? color : NULL; /* a scene with a sphere has none */
        out.status = status;
        out.error = error;
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        for (int i = 0; i < (mode == 2 ? 3 : 1); i++) {
            const float turn[3] = {i > 0 ? 0.001f : 0, 0, 0}, zero[3] = {0, 0, 0};
            dist_camera_move(&camera, turn, zero);
            CHECK_STATUS(DIST_OK, dist_render(ctx, field, &camera, &how, &out, tape), ctx);
        }
        note(r, "depth", depth, sizeof depth);
        note(r, "distance", along, sizeof along);
        note(r, "normal", normal, sizeof normal);
        note(r, "silhouette", silhouette, sizeof silhouette);
        note(r, "color", color, sizeof color);
        note(r, "status", status, sizeof status);
        note(r, "error", error, sizeof error);
        d_out.depth = d_out.silhouette = d_plane;
        d_out.normal = d_planes;
        d_out.color = field->color_fn ? d_planes : NULL;
        sums s = sums_make(field);
        s.to.rotation = s.numbers;
        s.to.translation = s.numbers + 3;
        s.to.focal = s.numbers + 6;
        s.to.principal = s.numbers + 8;
        if (field->color_fn) {
            s.to.color_code = s.to.weights + field->weight_count;
            s.to.color_weights = s.to.color_code + field->color_code_size;
        }
        CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &s.to), ctx);
        note(r, "gradient", s.numbers, s.count * sizeof(float));
        free(s.numbers);
        dist_tape_destroy(tape);
    }
}

static void life_of_queries(dist_context *ctx, const dist_field *field, results *r)
{
    dist_cache *cache = dist_cache_create(ctx, field, 16);
    dist_field cached = dist_cache_field(cache);
    const dist_field *of[2] = {field, &cached};
    for (int k = 0; k < 2; k++) {
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, of[k], FEW, points, found, numbers, NULL), ctx);
        note(r, "closest", found, 3 * FEW * sizeof(float));
        CHECK_STATUS(DIST_OK, dist_trace(ctx, of[k], POINTS, points, to, NULL, hits, NULL), ctx);
        note(r, "hits", hits, sizeof hits);
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, of[k], FEW, points, contacts), ctx);
        note(r, "contacts", contacts, FEW * sizeof *contacts);
    }
    dist_cache_destroy(cache);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, field, POINTS, points, numbers, found), ctx);
    note(r, "sdf", numbers, sizeof numbers);
    note(r, "grad f", found, sizeof found);
    if (field->color_fn) CHECK_STATUS(DIST_OK, dist_color_eval(ctx, field, POINTS, points, found), ctx);
    note(r, "colors", found, sizeof found);
    dist_mesh_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.resolution = 24;
    desc.normals = desc.refine = 1;
    dist_mesh *mesh = dist_mesh_extract(ctx, field, &desc);
    REQUIRE(mesh != NULL);
    note(r, "vertices", mesh->vertices, 3 * mesh->vertex_count * sizeof(float));
    sums s = sums_make(field);
    float loss;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(ctx, field, mesh, mesh->normals, &s.to), ctx);
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, field, FEW, points, 1, &loss, &s.to), ctx);
    for (int i = 0; i < POINTS; i++) numbers[i] = (float)(i % 7) - 3;
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, field, POINTS, points, numbers, NULL, NULL, found, &s.to), ctx);
    note(r, "gradients", s.numbers, s.count * sizeof(float));
    note(r, "grad f", found, sizeof found);
    double chamfer;
    CHECK_STATUS(DIST_OK, dist_chamfer(ctx, POINTS, points, mesh->vertex_count, mesh->vertices, &chamfer, NULL), ctx);
    note(r, "chamfer", &chamfer, sizeof chamfer);
    free(s.numbers);
    dist_mesh_destroy(mesh);
}

static void life(int workers, void (*life_fn)(dist_context *, const dist_field *, results *), results *r)
{
    crew c;
    dist_context_desc desc = test_context_desc();
    memset(&c, 0, sizeof c);
    r->count = 0;
    c.workers = desc.workers = workers;
    desc.scheduler.user = &c;
    desc.scheduler.run_fn = crew_run;
    pthread_mutex_init(&c.lock, NULL);
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    dist_net *paint = dist_net_load_file(ctx, "examples/model_color.safetensors");
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 3));
    CHECK_STATUS(DIST_OK, dist_shape_set_texture(shape, paint, dist_net_code(paint, 0)), ctx);
    const float ball[4] = {0, -0.4f, 0, 0.3f};
    dist_field fields[3] = {dist_shape_field(shape), dist_field_sphere(ball)};
    dist_instance instances[3];
    memset(instances, 0, sizeof instances);
    for (int i = 0; i < 3; i++) {
        instances[i].field = &fields[i / 2];
        instances[i].placement.translation[0] = 1.5f * (float)(i % 2);
        instances[i].placement.scale = i == 1 ? 0.7f : 1;
    }
    dist_scene *scene = dist_scene_create(ctx, 3, instances);
    fields[2] = dist_scene_field(scene);
    life_fn(ctx, &fields[0], r);
    life_fn(ctx, &fields[2], r);
    dist_scene_destroy(scene);
    dist_shape_destroy(shape);
    dist_net_destroy(paint);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    pthread_mutex_destroy(&c.lock);
}

static void same_results(void (*life_fn)(dist_context *, const dist_field *, results *))
{
    static results one, other;
    static const int workers[2] = {2, WORKERS};
    test_random random = test_random_seed(7);
    test_random_fill(&random, 4 * POINTS, points, -1.5f, 1.5f);
    test_random_fill(&random, 3 * POINTS, to, -1, 1);
    test_random_fill(&random, W * H, d_plane, -1, 1);
    test_random_fill(&random, 3 * W * H, d_planes, -1, 1);
    for (int i = 3; i < 4 * POINTS; i += 4) points[i] = fabsf(points[i]) / 8; /* of spheres the radius */
    life(1, life_fn, &one);
    for (int k = test_quick(); k < 2; k++) {
        life(workers[k], life_fn, &other);
        CHECK_EQUAL(one.count, other.count);
        for (int i = 0; i < one.count; i++)
            if (!CHECK(one.hashes[i] == other.hashes[i])) printf("    %s, result %d\n", one.names[i], i);
    }
    CHECK(one.count > 20);
}
#endif

TEST(threads_change_no_bit_of_pictures_and_their_gradients)
{
#ifdef THREADS
    same_results(life_of_pictures);
#else
    SKIP("there are no threads without an option of the compiler");
#endif
}

TEST(threads_change_no_bit_of_queries_meshes_and_their_gradients)
{
#ifdef THREADS
    same_results(life_of_queries);
#else
    SKIP("there are no threads without an option of the compiler");
#endif
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(threads_change_no_bit_of_pictures_and_their_gradients);
    RUN(threads_change_no_bit_of_queries_meshes_and_their_gradients);
    return test_report();
}
