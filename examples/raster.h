/* SPDX-License-Identifier: MIT-0
   raster.h - depth of a triangle mesh by a z-buffer, and its adjoint to the vertices: the baseline that the sphere
   tracer is compared with. The examples' code, not the library's. Include it after dist.h.

   forward   z = n . a / (n . r) of the nearest triangle a, b, c, with n = (b - a) x (c - a) and the pixel's ray r of
             depth 1, all in camera space
   backward  moving vertex k by v moves the hit by w_k (n . v) / (n . r) along z, w its barycentric weights there:
             d_vertex_k += d_depth w_k n / (n . r)
   Which triangle a pixel shows is held constant, so no gradient comes from the outline. A triangle that reaches behind
   the camera is left out. */
#ifndef DIST_EXAMPLES_RASTER_H
#define DIST_EXAMPLES_RASTER_H

#include <math.h>
#include <string.h>

static inline void raster_ray(const dist_camera *camera, int x, int y, double ray[3])
{
    ray[1] = ((double)y + (double)camera->pixel_center - (double)camera->cy) / (double)camera->fy;
    ray[0] = x + (double)camera->pixel_center - (double)camera->cx;
    ray[0] = (ray[0] - (double)camera->skew * ray[1]) / (double)camera->fx;
    ray[2] = 1.0;
}

/* The corners of a triangle in camera space, and its normal with twice its area as length. */
static inline void raster_triangle(const dist_camera *camera, const dist_mesh *mesh, size_t triangle, double corner[9],
                                   double normal[3])
{
    double u[3], v[3];
    for (int c = 0; c < 3; c++) {
        const float *p = mesh->vertices + 3 * (size_t)mesh->triangles[3 * triangle + (size_t)c];
        for (int i = 0; i < 3; i++) {
            const float *row = camera->rotation + 3 * i;
            corner[3 * c + i] = (double)row[0] * (double)p[0] + (double)row[1] * (double)p[1] +
                                (double)row[2] * (double)p[2] + (double)camera->translation[i];
        }
    }
    for (int i = 0; i < 3; i++) {
        u[i] = corner[3 + i] - corner[i];
        v[i] = corner[6 + i] - corner[i];
    }
    for (int i = 0; i < 3; i++) normal[i] = u[(i + 1) % 3] * v[(i + 2) % 3] - u[(i + 2) % 3] * v[(i + 1) % 3];
}

/* Barycentric weights of the point z r in the triangle's plane: areas seen along the ray. Returns n . r. */
static inline double raster_weights(const double corner[9], const double normal[3], const double ray[3],
                                    double weights[3])
{
    double sum = 0.0;
    for (int k = 0; k < 3; k++) {
        const double *a = corner + 3 * ((k + 1) % 3), *b = corner + 3 * ((k + 2) % 3);
        weights[k] = 0.0; /* the volume of ray, a, b: with one sign for all three, the ray passes between them */
        for (int i = 0; i < 3; i++)
            weights[k] += ray[i] * (a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
        sum += weights[k];
    }
    for (int k = 0; k < 3; k++) weights[k] = sum > 0.0 || sum < 0.0 ? weights[k] / sum : -1.0;
    return normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2];
}

/* depth, mask, triangle: (h, w); triangle: 1 + which one is seen, 0: none. */
static inline void raster_depth(const dist_camera *camera, const dist_mesh *mesh, float *depth, unsigned char *mask,
                                unsigned *triangle)
{
    size_t n = (size_t)camera->width * (size_t)camera->height;
    memset(depth, 0, n * sizeof *depth);
    memset(mask, 0, n);
    memset(triangle, 0, n * sizeof *triangle);
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        double corner[9], normal[3], low[2] = {1e30, 1e30}, high[2] = {-1e30, -1e30};
        int behind = 0;
        raster_triangle(camera, mesh, t, corner, normal);
        for (int c = 0; c < 3; c++) {
            const double *p = corner + 3 * c;
            behind |= !(p[2] > 1e-6);
            double v = (double)camera->fy * p[1] / p[2] + (double)camera->cy - (double)camera->pixel_center;
            double u = ((double)camera->fx * p[0] + (double)camera->skew * p[1]) / p[2] + (double)camera->cx -
                       (double)camera->pixel_center;
            low[0] = u < low[0] ? u : low[0];
            high[0] = u > high[0] ? u : high[0];
            low[1] = v < low[1] ? v : low[1];
            high[1] = v > high[1] ? v : high[1];
        }
        if (behind || high[0] < 0 || high[1] < 0 || low[0] > camera->width - 1 || low[1] > camera->height - 1) continue;
        int left = low[0] > 0 ? (int)ceil(low[0]) : 0, top = low[1] > 0 ? (int)ceil(low[1]) : 0;
        int right = high[0] < camera->width - 1 ? (int)high[0] : camera->width - 1;
        int bottom = high[1] < camera->height - 1 ? (int)high[1] : camera->height - 1;
        for (int y = top; y <= bottom; y++) {
            for (int x = left; x <= right; x++) {
                double ray[3], weights[3];
                raster_ray(camera, x, y, ray);
                double along = raster_weights(corner, normal, ray, weights);
                if (!(weights[0] >= 0.0 && weights[1] >= 0.0 && weights[2] >= 0.0)) continue;
                double z = (normal[0] * corner[0] + normal[1] * corner[1] + normal[2] * corner[2]) / along;
                size_t i = (size_t)y * (size_t)camera->width + (size_t)x;
                if (!(z > 0.0) || (mask[i] && (double)depth[i] <= z)) continue;
                depth[i] = (float)z;
                mask[i] = 1;
                triangle[i] = (unsigned)t + 1;
            }
        }
    }
}

/* d_vertices (vertex_count, 3) is added to. A triangle seen from its edge counts as tilted by at least 0.1. */
static inline void raster_backward(const dist_camera *camera, const dist_mesh *mesh, const unsigned *triangle,
                                   const float *d_depth, float *d_vertices)
{
    size_t n = (size_t)camera->width * (size_t)camera->height;
    for (size_t i = 0; i < n; i++) {
        double corner[9], normal[3], ray[3], weights[3];
        if (!triangle[i] || d_depth[i] == 0.0f) continue;
        raster_triangle(camera, mesh, triangle[i] - 1, corner, normal);
        raster_ray(camera, (int)(i % (size_t)camera->width), (int)(i / (size_t)camera->width), ray);
        double along = raster_weights(corner, normal, ray, weights), least = 0.0, size = 0.0;
        for (int k = 0; k < 3; k++) {
            least += normal[k] * normal[k];
            size += ray[k] * ray[k];
        }
        least = 0.1 * sqrt(least * size);
        if (fabs(along) < least) along = along < 0.0 ? -least : least;
        for (size_t c = 0; c < 3; c++) {
            float *d = d_vertices + 3 * (size_t)mesh->triangles[3 * (size_t)(triangle[i] - 1) + c];
            for (int k = 0; k < 3; k++) {
                double turned = 0.0;
                for (int m = 0; m < 3; m++) turned += (double)camera->rotation[3 * m + k] * normal[m];
                d[k] += (float)((double)d_depth[i] * weights[c] * turned / along);
            }
        }
    }
}

#endif
