/* SPDX-License-Identifier: MIT-0
   Isosurfaces, their adjoint, sampling and Chamfer distances. */
#include "test.h"

static const float torus_numbers[5] = {0.1f, -0.2f, 0.05f, 0.6f, 0.25f};

static int mesh_compare(const void *a, const void *b)
{
    uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
    return x < y ? -1 : x > y;
}

/* Each directed edge once, and its opposite once. */
static int mesh_closed(const dist_mesh *mesh)
{
    size_t n = 3 * mesh->triangle_count, bad = 0;
    uint64_t *edges = (uint64_t *)malloc((n + 1) * sizeof(uint64_t));
    if (!edges) return 0;
    for (size_t i = 0; i < n; i++) {
        uint64_t a = mesh->triangles[i], b = mesh->triangles[i % 3 == 2 ? i - 2 : i + 1];
        edges[i] = a << 32 | b;
        bad += a == b;
    }
    qsort(edges, n, sizeof(uint64_t), mesh_compare);
    for (size_t i = 0; i < n; i++) {
        uint64_t opposite = edges[i] << 32 | edges[i] >> 32;
        bad += i > 0 && edges[i] == edges[i - 1];
        bad += bsearch(&opposite, edges, n, sizeof(uint64_t), mesh_compare) == NULL;
    }
    free(edges);
    return bad == 0;
}

/* Sum of a . (b x c) / 6, positive for triangles counterclockwise from outside; d_vertices (n, 3) gets its gradient. */
static double mesh_volume(const dist_mesh *mesh, float *d_vertices)
{
    double volume = 0;
    if (d_vertices) memset(d_vertices, 0, mesh->vertex_count * 3 * sizeof(float));
    for (size_t i = 0; i < mesh->triangle_count; i++) {
        for (size_t s = 0; s < 3; s++) {
            size_t at[3];
            double p[3][3];
            for (size_t j = 0; j < 3; j++) {
                at[j] = mesh->triangles[3 * i + (s + j) % 3];
                for (size_t k = 0; k < 3; k++) p[j][k] = (double)mesh->vertices[3 * at[j] + k];
            }
            for (size_t k = 0; k < 3; k++) {
                size_t u = (k + 1) % 3, v = (k + 2) % 3;
                double cross = p[1][u] * p[2][v] - p[1][v] * p[2][u];
                if (s == 0) volume += p[0][k] * cross / 6;
                if (d_vertices) d_vertices[3 * at[0] + k] += (float)(cross / 6);
            }
        }
    }
    return volume;
}

static long mesh_euler(const dist_mesh *mesh)
{
    return (long)mesh->vertex_count - (long)(3 * mesh->triangle_count / 2) + (long)mesh->triangle_count;
}

static dist_mesh_desc mesh_desc(int resolution)
{
    dist_mesh_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.resolution = resolution;
    return desc;
}

/* Union of two spheres whose bounding sphere holds both. */
static void two_spheres_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        float x = fabsf(p[0]) - 0.5f, side = p[0] < 0 ? -1.0f : 1.0f;
        float length = sqrtf(x * x + p[1] * p[1] + p[2] * p[2]);
        sdf[i] = length - 0.3f;
        if (!gradient) continue;
        gradient[3 * i] = side * x / length;
        gradient[3 * i + 1] = p[1] / length;
        gradient[3 * i + 2] = p[2] / length;
    }
}

/* Values at the corners of a grid, by hash; outside along the border of the cube. */
typedef struct noise {
    uint64_t seed;
    int cells;
    int coarse; /* 1: values -1, 0, 1 only: many corners are exactly at level 0 */
    int poison; /* 1: NaN somewhere */
} noise;

static void noise_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    noise *noisy = (noise *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        uint64_t key = noisy->seed;
        int border = 0;
        for (size_t k = 0; k < 3; k++) {
            int at = (int)floor(((double)points[3 * i + k] + 1) * 0.5 * noisy->cells + 0.5);
            border |= at <= 0 || at >= noisy->cells;
            key = key * 1000003u + (uint64_t)at;
        }
        test_random r = test_random_seed(key);
        sdf[i] = noisy->coarse ? (float)test_random_int(&r, -1, 1) : test_random_float(&r, -1, 1);
        if (border) sdf[i] = 1.0f;
        if (noisy->poison && key % 1001 == 7) {
            uint32_t bits = 0x7fc00000u;
            memcpy(sdf + i, &bits, sizeof bits);
        }
        if (gradient) memset(gradient + 3 * i, 0, 3 * sizeof(float));
    }
}

static dist_field mesh_field(void *user, void (*eval_fn)(void *, int, size_t, const float *, float *, float *))
{
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = user;
    field.eval_fn = eval_fn;
    field.radius = 1.0f;
    return field;
}

TEST(every_cube_case_fans_closed_loops_without_diagonals_in_faces)
{
    int most = 0;
    for (int code = 0; code < 256; code++) {
        unsigned char edges[18];
        int count = inside_cube(code, edges);
        int uses[24][24], crossed = 0;
        memset(uses, 0, sizeof uses);
        most = count > most ? count : most;
        for (int i = 0; i < count; i++)
            for (int k = 0; k < 3; k++) uses[edges[3 * i + k]][edges[3 * i + (k + 1) % 3]]++;
        for (int e = 0; e < 24; e++) {
            int out = 0, edge = (e & 1 << (e >> 3)) == 0;
            int is_crossed = edge && ((code >> (e & 7) ^ code >> ((e & 7) | 1 << (e >> 3))) & 1);
            for (int f = 0; f < 24; f++) {
                CHECK(uses[e][f] <= 1);
                out += uses[e][f];
                /* an edge within the cell is used both ways, one in a face only one way */
                if (uses[e][f] && uses[f][e]) CHECK(!inside_edges_share_face(e, f));
                if (uses[e][f] && !uses[f][e]) CHECK(inside_edges_share_face(e, f));
            }
            CHECK_EQUAL(is_crossed, out > 0);
            crossed += is_crossed;
        }
        if (crossed == 0) CHECK_EQUAL(0, count);
    }
    CHECK(most <= 6);
}

TEST(torus_is_closed_outward_and_has_its_volume)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(64);
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    CHECK(mesh->triangle_count > 1000);
    CHECK(mesh_closed(mesh));
    CHECK_EQUAL(0, mesh_euler(mesh));
    double pi = 3.14159265358979, expected = 2 * pi * pi * 0.6 * 0.25 * 0.25;
    CHECK_NEAR(expected, mesh_volume(mesh, NULL), 0.01 * expected);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(two_spheres_are_two_closed_pieces)
{
    dist_context *ctx = test_context();
    dist_field field = mesh_field(NULL, two_spheres_eval);
    dist_mesh_desc desc = mesh_desc(50);
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    CHECK(mesh_closed(mesh));
    CHECK_EQUAL(4, mesh_euler(mesh));
    CHECK_NEAR(2 * 4.18879 * 0.027, mesh_volume(mesh, NULL), 3e-3);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

/* How many of the 256 cases occur in the cells of this noise. */
static int noise_cases(noise *noisy)
{
    unsigned char seen[256];
    int count = 0, cells = noisy->cells;
    memset(seen, 0, sizeof seen);
    for (int i = 0; i < cells * cells * cells; i++) {
        int code = 0;
        for (int c = 0; c < 8; c++) {
            float p[3], f;
            int at[3] = {i % cells + (c & 1), i / cells % cells + (c >> 1 & 1), i / cells / cells + (c >> 2)};
            for (int k = 0; k < 3; k++) p[k] = (float)(2.0 * at[k] / cells - 1);
            noise_eval(noisy, 0, 1, p, &f, NULL);
            code |= (f < 0) << c;
        }
        count += !seen[code];
        seen[code] = 1;
    }
    return count;
}

TEST(random_noise_is_closed_in_all_256_cases)
{
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 1;
    dist_context *ctx = dist_context_create(&context_desc);
    for (int round = 0; round < 6; round++) {
        noise noisy;
        memset(&noisy, 0, sizeof noisy);
        noisy.seed = 5u + (uint64_t)round;
        noisy.cells = round == 5 ? 3 : 25;
        noisy.coarse = round & 1;
        if (round == 0) CHECK_EQUAL(256, noise_cases(&noisy));
        dist_field field = mesh_field(&noisy, noise_eval);
        dist_mesh_desc desc = mesh_desc(noisy.cells);
        desc.no_skip = 1;
        dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
        REQUIRE(mesh);
        CHECK(mesh->triangle_count > 0);
        CHECK(mesh_closed(mesh));
        CHECK(mesh_volume(mesh, NULL) > 0);
        CHECK(test_finite_all(3 * mesh->vertex_count, mesh->vertices));
        dist_mesh_destroy(mesh);
    }
    dist_context_destroy(ctx);
}

static void counting_torus_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    dist_field field = dist_field_torus(torus_numbers);
    *(size_t *)user += n;
    field.eval_fn(field.user, worker, n, points, sdf, gradient);
}

TEST(skipping_changes_no_bit_and_saves_most_queries)
{
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 1;
    dist_context *ctx = dist_context_create(&context_desc);
    size_t queries = 0, skipping;
    dist_field field = dist_field_torus(torus_numbers);
    field.user = &queries;
    field.eval_fn = counting_torus_eval;
    for (int clamped = 0; clamped < 2; clamped++) {
        dist_mesh_desc desc = mesh_desc(100);
        field.clamp = clamped ? 0.1f : 0.0f;
        queries = 0;
        dist_mesh *a = dist_mesh_extract(ctx, &field, &desc);
        skipping = queries;
        desc.no_skip = 1;
        queries = 0;
        dist_mesh *b = dist_mesh_extract(ctx, &field, &desc);
        REQUIRE(a && b);
        CHECK_EQUAL(101 * 101 * 101, queries);
        CHECK(skipping * 3 < queries);
        CHECK(mesh_closed(a));
        if (CHECK_EQUAL(b->vertex_count, a->vertex_count)) CHECK_BYTES(a->vertex_count * 12, b->vertices, a->vertices);
        if (CHECK_EQUAL(b->triangle_count, a->triangle_count))
            CHECK_BYTES(a->triangle_count * 12, b->triangles, a->triangles);
        dist_mesh_destroy(a);
        dist_mesh_destroy(b);
    }
    dist_context_destroy(ctx);
}

/* Where a net's sampled Lipschitz figure ruled out a block that the surface pokes into, triangles were missing. */
TEST(a_net_is_closed_at_a_fine_resolution)
{
    dist_context *ctx = test_context();
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 130));
    dist_field field = dist_shape_field(shape);
    dist_mesh_desc desc = mesh_desc(256);
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh != NULL);
    CHECK(mesh->triangle_count > 100000);
    CHECK(mesh_closed(mesh));
    dist_mesh_destroy(mesh), dist_shape_destroy(shape), dist_net_destroy(net), dist_context_destroy(ctx);
}

TEST(refined_vertices_lie_on_the_surface_and_normals_are_analytic)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(24);
    desc.normals = 1;
    desc.refine = 3;
    desc.level = 0.05f;
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh && mesh->normals);
    for (size_t i = 0; i < mesh->vertex_count; i++) {
        float f, g[3];
        const float *n = mesh->normals + 3 * i;
        dist_field_eval(ctx, &field, 1, mesh->vertices + 3 * i, &f, g);
        CHECK_NEAR(0.05, f, 1e-6);
        CHECK_NEAR(1, n[0] * g[0] + n[1] * g[1] + n[2] * g[2], 1e-5);
    }
    CHECK(mesh_closed(mesh));
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

/* Steps along a gradient that points out of the cube end at its side. */
TEST(refined_vertices_stay_in_the_cube)
{
    float ball[4] = {0.3f, 0.2f, -0.1f, 0.5f};
    dist_context *ctx = test_context();
    dist_mesh_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.resolution = 13;
    desc.refine = 4;
    dist_field field = dist_field_sphere(ball);
    field.center[0] = 0;
    field.radius = 0.6f; /* cuts the ball off */
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh != NULL && mesh->vertex_count > 100);
    for (size_t i = 0; i < 3 * mesh->vertex_count; i++)
        CHECK(fabsf(mesh->vertices[i] - field.center[i % 3]) <= 0.6f * (1 + 1e-6f));
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(cells_finer_than_floats_are_refused)
{
    dist_context *ctx = test_context();
    for (int k = 0; k < 4; k++) {
        float ball[4] = {k < 2 ? 1e6f : -1e4f, 0, 0, 1};
        dist_mesh_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.resolution = k == 1 ? 4 : k == 3 ? 2048 : 0;
        dist_field field = dist_field_sphere(ball);
        dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
        CHECK((mesh != NULL) == (k == 1 || k == 2));
        if (k == 0) CHECK_TEXT("resolution is 128, must be at most 4, where cells", dist_context_message(ctx));
        dist_context_clear(ctx);
        double area = 0;
        for (size_t t = 0; mesh && t < mesh->triangle_count; t++) {
            double e[2][3], square = 0;
            for (int i = 0; i < 6; i++) {
                const unsigned *corner = mesh->triangles + 3 * t;
                const float *v = mesh->vertices + 3 * (size_t)corner[1 + i / 3];
                e[i / 3][i % 3] = (double)v[i % 3] - (double)mesh->vertices[3 * (size_t)corner[0] + (size_t)(i % 3)];
            }
            for (int i = 0; i < 3; i++) {
                double c = e[0][(i + 1) % 3] * e[1][(i + 2) % 3] - e[0][(i + 2) % 3] * e[1][(i + 1) % 3];
                square += c * c;
            }
            area += 0.5 * sqrt(square);
        }
        if (mesh) CHECK_NEAR(12.566, area, k == 1 ? 5 : 0.1);
        dist_mesh_destroy(mesh);
    }
    dist_context_destroy(ctx);
}

TEST(an_empty_surface_is_a_mesh_of_nothing)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(16);
    desc.level = -3.0f;
    desc.normals = 1;
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    CHECK_EQUAL(0, mesh->triangle_count);
    float d_code[5] = {0, 0, 0, 0, 0};
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(ctx, &field, mesh, NULL, &grads), ctx);
    for (int format = DIST_MESH_PLY; format <= DIST_MESH_OBJ; format++) { /* and a file of nothing is read back */
        unsigned char bytes[400];
        size_t size = 0;
        CHECK_STATUS(DIST_OK, dist_mesh_write(ctx, mesh, format, bytes, sizeof bytes, &size), ctx);
        dist_mesh *again = dist_mesh_read(ctx, bytes, size);
        REQUIRE(again);
        CHECK_EQUAL(0, again->vertex_count + again->triangle_count);
        dist_mesh_destroy(again);
    }
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(bad_descs_and_fields_are_refused)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(1);
    CHECK(!dist_mesh_extract(NULL, &field, NULL));
    CHECK(!dist_mesh_extract(ctx, NULL, NULL));
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    dist_context_clear(ctx);
    desc = mesh_desc(2049);
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_TEXT("resolution is 2049", dist_context_message(ctx));
    dist_context_clear(ctx);
    desc = mesh_desc(16);
    desc.refine = 9;
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_TEXT("refine is 9, must be 0 to 8", dist_context_message(ctx));
    dist_context_clear(ctx);
    desc = mesh_desc(16);
    desc.normals = 2;
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_TEXT("normals is 2, must be 0 to 1", dist_context_message(ctx));
    dist_context_clear(ctx);
    desc = mesh_desc(16);
    desc.no_skip = -3;
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_TEXT("no_skip is -3, must be 0 to 1", dist_context_message(ctx));
    dist_context_clear(ctx);
    const uint32_t nan = 0x7fc00000u;
    desc = mesh_desc(16);
    memcpy(&desc.level, &nan, sizeof nan);
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_TEXT("level is nan", dist_context_message(ctx));
    dist_context_clear(ctx);
    field.radius = 0;
    CHECK(!dist_mesh_extract(ctx, &field, NULL));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
    dist_context_destroy(ctx);
}

TEST(a_field_that_is_not_finite_is_refused)
{
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 1;
    dist_context *ctx = dist_context_create(&context_desc);
    noise noisy;
    memset(&noisy, 0, sizeof noisy);
    noisy.cells = 20;
    noisy.poison = 1;
    dist_field field = mesh_field(&noisy, noise_eval);
    dist_mesh_desc desc = mesh_desc(20);
    desc.no_skip = 1;
    CHECK(!dist_mesh_extract(ctx, &field, &desc));
    CHECK_STATUS(DIST_NOT_FINITE, dist_context_status(ctx), ctx);
    dist_context_destroy(ctx);
}

/* A distance in its cube, NaN beyond. */
static void cube_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const uint32_t nan = 0x7fc00000u;
    long *outside = (long *)user; /* one worker */
    (void)worker;
    (void)gradient;
    for (size_t i = 0; i < n; i++, points += 3) {
        double square = 0;
        int within = 1;
        for (int k = 0; k < 3; k++) {
            square += (double)points[k] * (double)points[k];
            within &= fabsf(points[k]) < 1.00001f;
        }
        sdf[i] = (float)(sqrt(square) - 0.9);
        *outside += !within;
        if (!within) memcpy(&sdf[i], &nan, sizeof nan);
    }
}

TEST(nothing_is_asked_outside_the_cube)
{
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 1;
    dist_context *ctx = dist_context_create(&context_desc);
    long outside = 0;
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = &outside;
    field.eval_fn = cube_eval;
    field.radius = 1;
    for (int resolution = 2; resolution <= 41; resolution++) {
        dist_mesh_desc desc = mesh_desc(resolution);
        dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
        REQUIRE(mesh != NULL);
        CHECK(mesh_closed(mesh));
        CHECK_NEAR(4.18879 * 0.729, mesh_volume(mesh, NULL), 3.4 * 4 / (resolution * resolution));
        dist_mesh_destroy(mesh);
    }
    CHECK_EQUAL(0, outside);
    dist_context_destroy(ctx);
}

TEST(extraction_gives_the_same_bits_for_every_worker_count)
{
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(40);
    desc.normals = 1;
    desc.refine = 1;
    dist_context *ctx = test_context();
    dist_mesh *a = dist_mesh_extract(ctx, &field, &desc);
    test_scheduler scheduler = {7, 0};
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 7;
    context_desc.scheduler = test_scheduler_hook(&scheduler);
    dist_context *other = dist_context_create(&context_desc);
    dist_mesh *b = dist_mesh_extract(other, &field, &desc);
    REQUIRE(a && b);
    REQUIRE(CHECK_EQUAL(a->vertex_count, b->vertex_count) && CHECK_EQUAL(a->triangle_count, b->triangle_count));
    CHECK_BYTES(a->vertex_count * 12, a->vertices, b->vertices);
    CHECK_BYTES(a->vertex_count * 12, a->normals, b->normals);
    CHECK_BYTES(a->triangle_count * 12, a->triangles, b->triangles);
    dist_mesh_destroy(a);
    dist_mesh_destroy(b);
    dist_context_destroy(other);
    dist_context_destroy(ctx);
}

static double torus_exact(const double *c, const double *p)
{
    double x = p[0] - c[0], y = p[1] - c[1], z = p[2] - c[2], h = sqrt(x * x + z * z) - c[3];
    return sqrt(h * h + y * y) - c[4];
}

/* How far the vertex moves along its normal until f = 0 for these numbers, by Newton in double. */
static double torus_shift(const double *c, const double *v, const double *normal)
{
    double s = 0;
    for (int step = 0; step < 8; step++) {
        double p[3], q[3];
        for (int k = 0; k < 3; k++) {
            p[k] = v[k] + s * normal[k];
            q[k] = p[k] + 1e-6 * normal[k];
        }
        double f = torus_exact(c, p);
        s -= f * 1e-6 / (torus_exact(c, q) - f);
    }
    return s;
}

TEST(mesh_adjoint_is_the_central_difference_of_moving_vertices)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(24);
    desc.refine = 3;
    desc.normals = 1;
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    test_random r = test_random_seed(3);
    float *d_vertices = (float *)malloc(mesh->vertex_count * 3 * sizeof(float));
    REQUIRE(d_vertices);
    test_random_fill(&r, 3 * mesh->vertex_count, d_vertices, -1, 1);
    float d_code[5] = {100, 0, 0, 0, 0};
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(ctx, &field, mesh, d_vertices, &grads), ctx);
    d_code[0] -= 100;
    for (size_t j = 0; j < 5; j++) {
        double c[5], change = 0, h = 1e-5, magnitude = 0;
        for (size_t i = 0; i < mesh->vertex_count; i++) {
            double v[3], n[3], dot = 0;
            for (size_t k = 0; k < 3; k++) {
                v[k] = (double)mesh->vertices[3 * i + k];
                n[k] = (double)mesh->normals[3 * i + k];
                dot += n[k] * (double)d_vertices[3 * i + k];
            }
            for (size_t k = 0; k < 5; k++) c[k] = (double)torus_numbers[k];
            c[j] += h;
            double up = torus_shift(c, v, n);
            c[j] -= 2 * h;
            change += dot * (up - torus_shift(c, v, n)) / (2 * h);
            magnitude += fabs(dot);
        }
        CHECK_NEAR(change, d_code[j], 1e-5 * magnitude);
    }
    free(d_vertices);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

/* Against the same seeds given to dist_field_backward, whose weights have tests of their own. */
TEST(the_mesh_adjoint_reaches_the_weights)
{
    dist_context *ctx = test_context();
    dist_net_desc tiny;
    memset(&tiny, 0, sizeof tiny);
    tiny.layers = 2;
    tiny.width = 16;
    tiny.geometric = 1;
    dist_net *net = dist_net_create(ctx, &tiny);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    dist_mesh_desc desc = mesh_desc(48); /* more vertices than are sent back at once */
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh && mesh->vertex_count > 4096);
    size_t n = mesh->vertex_count, count = dist_net_weight_count(net);
    float *memory = (float *)calloc(8 * n + 2 * count, sizeof(float));
    REQUIRE(memory);
    float *d_vertices = memory, *gradient = d_vertices + 3 * n, *sdf = gradient + 3 * n, *d_sdf = sdf + n;
    float *d_weights = d_sdf + n, *expected = d_weights + count;
    test_random r = test_random_seed(5);
    test_random_fill(&r, 3 * n, d_vertices, -1, 1);
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.weights = d_weights;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(ctx, &field, mesh, d_vertices, &grads), ctx);
    dist_field_eval(ctx, &field, n, mesh->vertices, sdf, gradient);
    for (size_t i = 0; i < n; i++) {
        double dot = 0, square = 0;
        for (size_t k = 3 * i; k < 3 * i + 3; k++) {
            dot += (double)gradient[k] * (double)d_vertices[k];
            square += (double)gradient[k] * (double)gradient[k];
        }
        d_sdf[i] = square > 0 ? (float)(-dot / square) : 0.0f;
    }
    grads.weights = expected;
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, n, mesh->vertices, d_sdf, NULL, NULL, NULL, &grads), ctx);
    double off = 0, all = 0;
    for (size_t i = 0; i < count; i++) {
        off += fabs((double)d_weights[i] - (double)expected[i]);
        all += fabs((double)expected[i]);
    }
    CHECK(all > 1);
    CHECK_NEAR(0, off / all, 1e-4);
    free(memory);
    dist_mesh_destroy(mesh);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(volume_of_the_extracted_torus_has_the_derivative_of_its_formula)
{
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(64);
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    REQUIRE(mesh);
    float *d_vertices = (float *)malloc(mesh->vertex_count * 3 * sizeof(float));
    REQUIRE(d_vertices);
    mesh_volume(mesh, d_vertices);
    float d_code[5] = {0, 0, 0, 0, 0};
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = d_code;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(ctx, &field, mesh, d_vertices, &grads), ctx);
    double pi = 3.14159265358979, d_ring = 2 * pi * pi * 0.25 * 0.25, d_tube = 4 * pi * pi * 0.6 * 0.25;
    for (size_t j = 0; j < 3; j++) CHECK_NEAR(0, d_code[j], 1e-3);
    CHECK_NEAR(d_ring, d_code[3], 0.01 * d_ring);
    CHECK_NEAR(d_tube, d_code[4], 0.01 * d_tube);
    free(d_vertices);
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(every_allocation_of_an_extraction_may_fail)
{
    dist_field field = dist_field_torus(torus_numbers);
    dist_mesh_desc desc = mesh_desc(32);
    desc.normals = 1;
    int done = 0;
    for (size_t n = 1; !done && n < 200; n++) {
        test_allocator a;
        memset(&a, 0, sizeof a);
        dist_context_desc context_desc = test_context_desc();
        context_desc.allocator = test_allocator_hook(&a);
        dist_context *ctx = dist_context_create(&context_desc);
        REQUIRE(ctx);
        a.fail_at = a.requests + n;
        a.fail_onwards = (int)(n & 1);
        dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
        done = mesh != NULL;
        if (!mesh) CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
        dist_mesh_destroy(mesh);
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, a.live_blocks);
        CHECK_EQUAL(0, a.errors);
    }
    CHECK(done);
}

TEST(a_mesh_of_ones_own_is_checked)
{
    dist_context *ctx = test_context();
    float vertices[9] = {0, 0, 0, 1, 0, 0, 0, 1, 0};
    unsigned triangles[3] = {0, 1, 2};
    dist_mesh *mesh = dist_mesh_create(ctx, 3, vertices, 1, triangles);
    REQUIRE(mesh);
    dist_mesh_destroy(mesh);
    mesh = dist_mesh_create(ctx, 0, NULL, 0, NULL);
    CHECK(mesh);
    dist_mesh_destroy(mesh);
    dist_mesh_destroy(NULL);
    CHECK(!dist_mesh_create(ctx, 2, vertices, 1, triangles));
    CHECK_TEXT("vertex 2", dist_context_message(ctx));
    dist_context_clear(ctx);
    /* more than there can be: said before anything is read */
    CHECK(!dist_mesh_create(ctx, (size_t)-1, vertices, 1, triangles));
    CHECK_TEXT("more than there can be", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(!dist_mesh_create(ctx, 3, vertices, (size_t)-1 / 2, triangles));
    CHECK_TEXT("3 vertices and", dist_context_message(ctx));
    dist_context_clear(ctx);
    /* spoiled afterwards: told to the context that is asked, not to the one that made it */
    dist_context *other = test_context();
    mesh = dist_mesh_create(other, 3, vertices, 1, triangles);
    REQUIRE(mesh);
    mesh->triangles[2] = 9;
    size_t size;
    float point[3];
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_sample(ctx, mesh, 1, 1, point), ctx);
    CHECK_TEXT("dist_mesh_sample: a triangle has vertex 9, must be below 3", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_write(ctx, mesh, DIST_MESH_PLY, NULL, 0, &size), ctx);
    CHECK_TEXT("dist_mesh_write: a triangle has vertex 9", dist_context_message(ctx));
    dist_context_clear(ctx);
    mesh->triangles[2] = 2;
    for (int missing = 0; missing < 2; missing++) {
        dist_mesh part = *mesh;
        const char *text = missing ? "triangles is NULL, but its count" : "vertices is NULL, but its count";
        if (missing) part.triangles = NULL;
        else part.vertices = NULL;
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_sample(ctx, &part, 1, 1, point), ctx);
        CHECK_TEXT(text, dist_context_message(ctx));
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_write(ctx, &part, DIST_MESH_OBJ, NULL, 0, &size), ctx);
        CHECK_TEXT(text, dist_context_message(ctx));
        dist_context_clear(ctx);
        if (missing) continue;
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_backward(ctx, NULL, &part, vertices, &grads), ctx);
        CHECK_TEXT(text, dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    CHECK_STATUS(DIST_OK, dist_context_status(other), other);
    dist_mesh_destroy(mesh);
    dist_context_destroy(other);
    uint32_t bits = 0x7f800000u;
    memcpy(vertices + 4, &bits, sizeof bits);
    CHECK(!dist_mesh_create(ctx, 3, vertices, 1, triangles));
    CHECK_STATUS(DIST_NOT_FINITE, dist_context_status(ctx), ctx);
    dist_context_clear(ctx);
    CHECK(!dist_mesh_create(ctx, (size_t)-1 / 2, vertices, 1, triangles));
    CHECK(!dist_mesh_create(ctx, 3, NULL, 1, triangles));
    dist_context_destroy(ctx);
}

TEST(samples_are_uniform_over_the_area_and_repeat_for_a_seed)
{
    dist_context *ctx = test_context();
    float vertices[18] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 5, 3, 0, 5, 0, 1, 5};
    unsigned triangles[9] = {0, 1, 2, 0, 0, 0, 3, 4, 5}; /* areas 1/2, 0, 3/2 */
    enum { COUNT = 40000 };
    float *p = (float *)malloc(2 * COUNT * 3 * sizeof(float));
    REQUIRE(p);
    dist_mesh *mesh = dist_mesh_create(ctx, 6, vertices, 3, triangles);
    REQUIRE(mesh);
    CHECK_STATUS(DIST_OK, dist_mesh_sample(ctx, mesh, 5, COUNT, p), ctx);
    CHECK_STATUS(DIST_OK, dist_mesh_sample(ctx, mesh, 5, COUNT, p + 3 * COUNT), ctx);
    CHECK_BYTES(COUNT * 12, p, p + 3 * COUNT);
    double upper = 0, x = 0, y = 0;
    for (size_t i = 0; i < COUNT; i++) {
        int up = p[3 * i + 2] > 2;
        double px = (double)p[3 * i] / (up ? 3 : 1), py = (double)p[3 * i + 1];
        CHECK(px >= 0 && py >= 0 && px + py <= 1 + 1e-6);
        upper += up;
        x += px;
        y += py;
    }
    CHECK_NEAR(0.75, upper / (double)COUNT, 0.01);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_sample(ctx, mesh, 5, (size_t)-1, p), ctx);
    dist_context_clear(ctx);
    CHECK_NEAR(1.0 / 3, x / (double)COUNT, 0.005);
    CHECK_NEAR(1.0 / 3, y / (double)COUNT, 0.005);
    mesh->triangle_count = 0;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_sample(ctx, mesh, 5, 1, p), ctx);
    mesh->triangle_count = 3;
    dist_mesh_destroy(mesh);
    free(p);
    dist_context_destroy(ctx);
}

static double nearest_mean(size_t n, const float *a, size_t m, const float *b)
{
    double sum = 0;
    for (size_t i = 0; i < n; i++) {
        double best = 1e300;
        for (size_t j = 0; j < m; j++) {
            double d = 0;
            for (size_t k = 0; k < 3; k++) {
                double x = (double)a[3 * i + k] - (double)b[3 * j + k];
                d += x * x;
            }
            if (d < best) best = d;
        }
        sum += best;
    }
    return sum / (double)n;
}

/* Kinds of clouds: uniform, sphere, all equal, on a line, one outlier, quantized, two clusters. */
static void cloud_fill(test_random *r, int kind, size_t n, float *p)
{
    for (size_t i = 0; i < n; i++) {
        float *q = p + 3 * i;
        test_random_fill(r, 3, q, -1, 1);
        if (kind == 1) test_random_direction(r, q);
        if (kind == 2) q[0] = q[1] = q[2] = 0.25f;
        if (kind == 3) q[1] = q[2] = q[0] * 0.5f;
        if (kind == 4 && i == n / 2) q[0] = 1e18f;
        if (kind == 5)
            for (size_t k = 0; k < 3; k++) q[k] = floorf(q[k] * 2);
        if (kind == 6) q[0] += i % 2 ? 1e6f : 0;
    }
}

TEST(chamfer_is_that_of_all_pairs)
{
    dist_context *ctx = test_context();
    test_random r = test_random_seed(9);
    for (int round = 0; round < 7 * 8; round++) {
        static const int sizes[8] = {1, 2, 7, 8, 9, 17, 100, 700};
        float a[3 * 700], b[3 * 700];
        double chamfer = 0, one_way[2];
        size_t n = (size_t)sizes[round % 8], m = (size_t)sizes[(round * 5 + 3) % 8];
        cloud_fill(&r, round / 8, n, a);
        cloud_fill(&r, (round / 8 + round) % 7, m, b);
        CHECK_STATUS(DIST_OK, dist_chamfer(ctx, n, a, m, b, &chamfer, one_way), ctx);
        double there = nearest_mean(n, a, m, b), back = nearest_mean(m, b, n, a);
        CHECK_NEAR(there, one_way[0], 1e-12 * there);
        CHECK_NEAR(back, one_way[1], 1e-12 * back);
        CHECK_NEAR(there + back, chamfer, 1e-12 * (there + back));
    }
    dist_context_destroy(ctx);
}

TEST(chamfer_of_30000_points_is_quick_for_every_kind_of_cloud)
{
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 1;
    dist_context *ctx = dist_context_create(&context_desc);
    test_random r = test_random_seed(10);
    size_t n = test_quick() ? 3000 : 30000;
    float *a = (float *)malloc(n * 3 * sizeof(float)), *b = (float *)malloc(n * 3 * sizeof(float));
    REQUIRE(a && b);
    for (int kind = 0; kind < 7; kind++) {
        double chamfer;
        cloud_fill(&r, kind, n, a);
        cloud_fill(&r, kind, n, b);
        clock_t begin = clock();
        CHECK_STATUS(DIST_OK, dist_chamfer(ctx, n, a, n, b, &chamfer, NULL), ctx);
        double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
        if (test_state.verbose) printf("    kind %d: %.3f s\n", kind, seconds);
        CHECK(seconds < 3); /* quadratic: far above; what is meant is 0.2 */
    }
    free(a);
    free(b);
    dist_context_destroy(ctx);
}

TEST(chamfer_gives_the_same_bits_for_every_worker_count)
{
    test_random r = test_random_seed(11);
    enum { COUNT = 5000 };
    float *a = (float *)malloc(COUNT * 12), *b = (float *)malloc(COUNT * 12);
    REQUIRE(a && b);
    test_random_fill(&r, 3 * COUNT, a, -1, 1);
    test_random_fill(&r, 3 * COUNT, b, -1, 1);
    dist_context *ctx = test_context();
    test_scheduler scheduler = {7, 0};
    dist_context_desc context_desc = test_context_desc();
    context_desc.workers = 7;
    context_desc.scheduler = test_scheduler_hook(&scheduler);
    dist_context *other = dist_context_create(&context_desc);
    double x = 0, y = 1;
    dist_chamfer(ctx, COUNT, a, COUNT, b, &x, NULL);
    dist_chamfer(other, COUNT, a, COUNT, b, &y, NULL);
    CHECK_BYTES(sizeof x, &x, &y);
    free(a);
    free(b);
    dist_context_destroy(other);
    dist_context_destroy(ctx);
}

TEST(chamfer_refuses_points_that_are_not_finite_and_empty_clouds)
{
    dist_context *ctx = test_context();
    float a[6] = {0, 0, 0, 1, 1, 1}, b[3] = {0, 0, 0};
    double chamfer;
    uint32_t bits = 0x7fc00000u;
    memcpy(a + 4, &bits, sizeof bits);
    CHECK_STATUS(DIST_NOT_FINITE, dist_chamfer(ctx, 2, a, 1, b, &chamfer, NULL), ctx);
    CHECK_TEXT("point 1 of a", dist_context_message(ctx));
    CHECK_STATUS(DIST_NOT_FINITE, dist_chamfer(ctx, 1, b, 2, a, &chamfer, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_chamfer(ctx, 0, a, 1, b, &chamfer, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_chamfer(ctx, 1, b, 1, NULL, &chamfer, NULL), ctx);
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_chamfer(ctx, 1, b, (size_t)-1, b, &chamfer, NULL), ctx);
    CHECK_TEXT("dist_chamfer: b has", dist_context_message(ctx));
    CHECK_TEXT("more than memory can hold", dist_context_message(ctx));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_chamfer(NULL, 1, b, 1, b, &chamfer, NULL), NULL);
    dist_context_destroy(ctx);
}

TEST(what_a_mesh_has_not_is_told)
{
    dist_context *ctx = test_context();
    float vertices[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0}, point[3], d_vertices[9] = {0}, sphere[4] = {0, 0, 0, 0.5f};
    unsigned triangle[3] = {0, 1, 2};
    size_t size = 0;
    uint32_t bits = 0xff800000u;
    dist_mesh *mesh = dist_mesh_create(ctx, 3, vertices, 1, triangle);
    dist_field field = dist_field_sphere(sphere);
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    REQUIRE(mesh);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_sample(ctx, mesh, 1, 1, point), ctx);
    CHECK_TEXT("dist_mesh_sample: the mesh's area is 0, must be positive", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_write(ctx, mesh, 2, NULL, 0, &size), ctx);
    CHECK_TEXT("dist_mesh_write: format is 2, must be DIST_MESH_PLY or DIST_MESH_OBJ", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_mesh_backward(ctx, &field, mesh, NULL, &grads), ctx);
    CHECK_TEXT("dist_mesh_backward: d_vertices is NULL", dist_context_message(ctx));
    dist_context_clear(ctx);
    memcpy(d_vertices + 7, &bits, sizeof bits);
    CHECK_STATUS(DIST_NOT_FINITE, dist_mesh_backward(ctx, &field, mesh, d_vertices, &grads), ctx);
    CHECK_TEXT("dist_mesh_backward: d_vertices of vertex 2 is not finite", dist_context_message(ctx));
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

TEST(every_allocation_of_sampling_and_chamfer_may_fail)
{
    float vertices[9] = {0, 0, 0, 1, 0, 0, 0, 1, 0}, p[30];
    unsigned triangles[3] = {0, 1, 2};
    int done = 0;
    for (size_t n = 1; !done && n < 50; n++) {
        test_allocator a;
        memset(&a, 0, sizeof a);
        dist_context_desc context_desc = test_context_desc();
        context_desc.allocator = test_allocator_hook(&a);
        dist_context *ctx = dist_context_create(&context_desc);
        REQUIRE(ctx);
        double chamfer;
        a.fail_at = a.requests + n;
        dist_mesh *mesh = dist_mesh_create(ctx, 3, vertices, 1, triangles);
        memset(p, 0, sizeof p);
        done = mesh && dist_mesh_sample(ctx, mesh, 1, 10, p) == DIST_OK &&
               dist_chamfer(ctx, 10, p, 3, vertices, &chamfer, NULL) == DIST_OK;
        if (!done) CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
        dist_mesh_destroy(mesh);
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, a.live_blocks);
        CHECK_EQUAL(0, a.errors);
    }
    CHECK(done);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(every_cube_case_fans_closed_loops_without_diagonals_in_faces);
    RUN(torus_is_closed_outward_and_has_its_volume);
    RUN(two_spheres_are_two_closed_pieces);
    RUN(random_noise_is_closed_in_all_256_cases);
    RUN(skipping_changes_no_bit_and_saves_most_queries);
    RUN(a_net_is_closed_at_a_fine_resolution);
    RUN(refined_vertices_lie_on_the_surface_and_normals_are_analytic);
    RUN(refined_vertices_stay_in_the_cube);
    RUN(cells_finer_than_floats_are_refused);
    RUN(an_empty_surface_is_a_mesh_of_nothing);
    RUN(bad_descs_and_fields_are_refused);
    RUN(a_field_that_is_not_finite_is_refused);
    RUN(nothing_is_asked_outside_the_cube);
    RUN(extraction_gives_the_same_bits_for_every_worker_count);
    RUN(mesh_adjoint_is_the_central_difference_of_moving_vertices);
    RUN(the_mesh_adjoint_reaches_the_weights);
    RUN(volume_of_the_extracted_torus_has_the_derivative_of_its_formula);
    RUN(every_allocation_of_an_extraction_may_fail);
    RUN(a_mesh_of_ones_own_is_checked);
    RUN(samples_are_uniform_over_the_area_and_repeat_for_a_seed);
    RUN(chamfer_is_that_of_all_pairs);
    RUN(chamfer_of_30000_points_is_quick_for_every_kind_of_cloud);
    RUN(chamfer_gives_the_same_bits_for_every_worker_count);
    RUN(chamfer_refuses_points_that_are_not_finite_and_empty_clouds);
    RUN(what_a_mesh_has_not_is_told);
    RUN(every_allocation_of_sampling_and_chamfer_may_fail);
    return test_report();
}
